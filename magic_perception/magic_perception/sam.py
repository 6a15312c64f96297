"""Masks by Segment Anything (Kirillov et al. 2023; SAM 2: Ravi et al. 2024) through transformers, prompted by the depth clusters.

The network says which thing a pixel belongs to.  What is no thing's, by depth and colour together (the table, smear past an edge, the hole
of a handle, a shadow without depth), stays out of its masks, which are as coarse as a quarter of the network's picture.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import devices
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.workers import Workers
from magic_perception import clusters
from magic_perception.foreground import foreground
from magic_perception.labels import sizeable
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.segmentation import DepthSegmenter

#: Weights taken where none are named; the hub is asked only then.
DEFAULTS = {"sam": "facebook/sam-vit-base", "sam2": "facebook/sam2.1-hiera-tiny"}

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)


class SamSegmenter:
    """The ``depth`` segmenter's clusters as prompts (a box and three points each), SAM's masks as the answer.

    Both go through :func:`magic_perception.foreground.foreground`, so that edges and holes are as sharp as those of ``depth``.
    weights: a hub name or a local folder.  A mask that does not agree with its prompt (IoU below ``agree``) is refused,
    and the cluster's own mask kept: a confident network is no reason to lose an object.
    Raises ``SEGMENTER_WEIGHTS`` where the weights cannot be loaded.
    """

    def __init__(
        self, name: str, weights: str = "", device: str = devices.AUTO, workers: Workers | None = None, agree: float = 0.5
    ) -> None:
        self.name = name
        self._coarse = DepthSegmenter(workers=workers)
        self.agree = agree
        source = weights or DEFAULTS[name]
        try:
            import torch
            import transformers

            kind = transformers.SamModel if name == "sam" else transformers.Sam2Model
            self._torch, self.device = torch, devices.chosen(device)
            self._model: Any = kind.from_pretrained(source).eval().to(self.device)
        except Exception as error:  # transformers raises many kinds: no network, no such folder, wrong kind of model
            raise MagicError(
                Code.SEGMENTER_WEIGHTS, f"weights of segmenter {name}", f"{source}: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
                "a hub name that can be reached or a local folder made by save_pretrained",
            ) from error  # fmt: skip
        config = self._model.config.vision_config
        size = getattr(config, "image_size", None)
        if size is None:
            size = (
                getattr(getattr(config, "backbone_config", None), "image_size", None) or self._model.config.prompt_encoder_config.image_size
            )
        self._size = int(size[0] if isinstance(size, (list, tuple)) else size)

    def segment(self, looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> list[NDArray[np.int32]]:
        """See :class:`magic_perception.segmentation.Segmenter`."""
        labels = self._coarse.segment(looks, known, parameters)
        return sizeable([self._refine(looked, image, parameters) for looked, image in zip(looks, labels, strict=True)], looks, parameters)

    def _refine(self, looked: Looked, labels: NDArray[np.int32], parameters: Parameters) -> NDArray[np.int32]:
        numbers = [int(n) for n in np.unique(labels) if n > 0]
        if not numbers:
            return labels
        masks = self.masks(looked.frame.color, [labels == n for n in numbers])
        result = np.where(labels < 0, labels, 0).astype(np.int32)
        best = np.zeros(labels.shape, np.float32)
        possible, _ = foreground(looked, parameters)
        for number, (probability, _) in zip(numbers, masks, strict=True):
            prompt = labels == number
            mask = probability > 0.5
            union = (mask | prompt).sum()
            if union == 0 or (mask & prompt).sum() < self.agree * union:
                mask, probability = prompt, np.where(prompt, 0.75, 0).astype(np.float32)
            else:
                mask = clusters.connected(mask & (possible | prompt), prompt)
            takes = mask & (probability > best) & (labels >= 0)
            result[takes] = number
            best[takes] = probability[takes]
        return result

    def masks(self, color: NDArray[np.uint8], prompts: list[NDArray[np.bool_]]) -> list[tuple[NDArray[np.float32], float]]:
        """For each prompt mask (H, W) the probability (H, W) of the network's best mask, and its own estimate of its IoU.

        The image is encoded once.  SAM scales the long side to its input size and pads; SAM 2 stretches to a square.
        """
        torch = self._torch
        height, width = color.shape[:2]
        size = self._size
        scale = (size / max(height, width),) * 2 if self.name == "sam" else (size / width, size / height)
        scaled = (max(1, round(width * scale[0])), max(1, round(height * scale[1])))
        picture = (cv2.resize(color, scaled, interpolation=cv2.INTER_AREA).astype(np.float32) / 255 - _MEAN) / _STD
        padded = np.zeros((size, size, 3), np.float32)
        padded[: scaled[1], : scaled[0]] = picture
        boxes, points = [], []
        for prompt in prompts:
            rows, columns = np.nonzero(prompt)
            boxes.append([columns.min(), rows.min(), columns.max(), rows.max()])
            points.append(_inner_points(prompt, 3))
        factor = np.array([scale[0], scale[1]])
        with torch.inference_mode():
            pixels = torch.from_numpy(padded.transpose(2, 0, 1)[None].copy()).to(self.device)
            embeddings = self._model.get_image_embeddings(pixels)
            answer = self._model(
                image_embeddings=embeddings,
                input_boxes=torch.tensor(np.array([boxes], np.float32) * np.tile(factor, 2).astype(np.float32)).to(self.device),
                input_points=torch.tensor((np.array([points]) * factor).astype(np.float32)).to(self.device),
                input_labels=torch.ones((1, len(prompts), 3), dtype=torch.int64 if self.name == "sam" else torch.int32, device=self.device),
                multimask_output=False,
            )
            logits = answer.pred_masks[0, :, 0].float()
            logits = torch.nn.functional.interpolate(logits[None], (size, size), mode="bilinear", align_corners=False)
            logits = torch.nn.functional.interpolate(
                logits[..., : scaled[1], : scaled[0]], (height, width), mode="bilinear", align_corners=False
            )[0]
            probability = torch.sigmoid(logits).cpu().numpy()
            scores = answer.iou_scores[0, :, 0].float().cpu().numpy()
        return [(probability[i], float(scores[i])) for i in range(len(prompts))]


def _inner_points(mask: NDArray[np.bool_], count: int) -> list[list[float]]:
    """Points (u, v) deep inside a mask, far from each other: maxima of the distance to its edge, each blotted out before the next."""
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    found = []
    rows, columns = np.nonzero(mask)
    blot = max(3.0, 0.3 * float(np.hypot(np.ptp(rows), np.ptp(columns))))
    for _ in range(count):
        v, u = np.unravel_index(int(np.argmax(distance)), distance.shape)
        if distance[v, u] <= 0:
            found.append(found[0])
            continue
        found.append([float(u), float(v)])
        cv2.circle(distance, (int(u), int(v)), int(blot), 0.0, -1)
    return found
