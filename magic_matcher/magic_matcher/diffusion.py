"""Features of Stable Diffusion's U-Net, alone (DIFT) and beside DINOv2's (SD-DINO): the other rows of the paper's Table IV.

``dift``     Tang et al. 2023: noise of one step is added to the picture's latents, and the output of one up block of the U-Net, prompted
             with nothing, is the feature map; the mean over several draws of the noise.  Their settings for semantic correspondence.
``sd_dino``  Zhang et al. 2023: outputs of three up blocks at an early step, beside DINOv2's tokens, each part of unit length, half the
             weight for each.  They reduce the three blocks by a PCA of a picture pair before; here each block is scaled to unit length, and
             the matcher's joint PCA comes after.  Their prompts are the picture's caption; ours is empty.

The weights are a hub name or a folder as diffusers saves a Stable Diffusion pipeline (``unet``, ``vae``, ``scheduler``, ``text_encoder``,
``tokenizer``).  diffusers is an extra: ``pip install -r ros2_ws/requirements-diffusion.txt``.
"""

from __future__ import annotations

import hashlib
import threading
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import devices
from magic_core.errors import Code, MagicError
from magic_core.weights import loading
from magic_matcher import global_matching
from magic_matcher.dinov2 import Dinov2Features

#: Step of the noise, up blocks, and draws of the noise that are averaged.
DIFT_STEP, DIFT_BLOCKS, DIFT_DRAWS = 261, (1,), 8
SD_DINO_STEP, SD_DINO_BLOCKS = 100, (0, 1, 2)
#: What makes a folder one of weights.
PARTS = ("unet", "vae", "scheduler", "text_encoder", "tokenizer")
#: Share of the squared length that Stable Diffusion's part has of SD-DINO's features.
SHARE = 0.5


class UNet:
    """Feature maps of a U-Net's up blocks.

    size: side of the pictures in pixels, a multiple of 64; step, blocks, draws: as of :data:`DIFT_STEP` and its neighbours; seed: of the
    noise.  Raises ``FEATURE_WEIGHTS`` where diffusers or the weights are missing.
    """

    def __init__(
        self, weights: str, device: str, size: int, step: int, blocks: tuple[int, ...], draws: int, seed: int = 0, precision: str = "auto"
    ) -> None:
        try:
            import torch
            from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
            from transformers import AutoTokenizer, CLIPTextModel
        except ImportError as error:
            raise MagicError(
                Code.FEATURE_WEIGHTS, "diffusion features", str(error), "pip install -r ros2_ws/requirements-diffusion.txt"
            ) from error
        allowed = f"a hub name that can be reached, or a folder of a Stable Diffusion pipeline with {', '.join(PARTS)}"
        with loading(weights, device, allowed):
            self._torch = torch
            self._device = torch.device(devices.chosen(device))
            half = "float32" if self._device.type == "cpu" else "float16"
            self._dtype = getattr(torch, half if precision == "auto" else precision)

            def part(kind: Any, name: str) -> Any:
                return kind.from_pretrained(weights, subfolder=name).to(self._device, self._dtype).eval()

            self._unet, self._vae = part(UNet2DConditionModel, "unet"), part(AutoencoderKL, "vae")
            self._scheduler = DDIMScheduler.from_pretrained(weights, subfolder="scheduler")
            tokenizer = AutoTokenizer.from_pretrained(weights, subfolder="tokenizer")
            words = part(CLIPTextModel, "text_encoder")
            ids = tokenizer("", padding="max_length", max_length=words.config.max_position_embeddings, truncation=True, return_tensors="pt")
            with torch.inference_mode():
                self._prompt = words(ids.input_ids.to(self._device))[0]
        highest = len(self._unet.up_blocks) - 1
        if max(blocks) > highest:
            raise MagicError(Code.FEATURE_WEIGHTS, f"up block of {weights}", max(blocks), f"up to {highest}: the U-Net has no more")
        self.size, self._step, self._blocks, self._draws, self._seed = size, step, blocks, draws, seed
        self._weights = str(weights)

    def key(self) -> str:
        """A name for weights (for a folder the files' sizes and times) and settings."""
        text = f"{self.size} {self._step} {self._blocks} {self._draws} {self._seed} {self._dtype}"
        return hashlib.sha256(f"{global_matching.state_of(self._weights)} {text}".encode()).hexdigest()

    def maps(self, picture: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
        """Feature maps (n_k, n_k, d_k), one for each of the blocks, of a picture (S, S, 3) uint8 RGB."""
        torch = self._torch
        caught: dict[int, Any] = {}
        hooks = [
            self._unet.up_blocks[k].register_forward_hook(lambda _module, _given, out, k=k: caught.__setitem__(k, out))
            for k in self._blocks
        ]
        try:
            with torch.inference_mode():
                pixels = torch.from_numpy(picture.astype(np.float32).transpose(2, 0, 1)[None] / 127.5 - 1).to(self._device, self._dtype)
                latents = self._vae.encode(pixels).latent_dist.mode() * self._vae.config.scaling_factor
                at = torch.tensor([self._step], device=self._device)
                # The same noise for every picture: what differs is what is seen.
                source = torch.Generator().manual_seed(self._seed)
                sums: dict[int, Any] = {}
                for _ in range(self._draws):
                    noise = torch.randn(latents.shape, generator=source).to(self._device, self._dtype)
                    self._unet(self._scheduler.add_noise(latents, noise, at), at, encoder_hidden_states=self._prompt)
                    for k, out in caught.items():
                        sums[k] = out.float() if k not in sums else sums[k] + out.float()
                return [(sums[k][0] / self._draws).permute(1, 2, 0).cpu().numpy() for k in self._blocks]
        finally:
            for hook in hooks:
                hook.remove()


class DiffusionFeatures(global_matching.NetworkFeatures):
    """A backend on :class:`UNet`, with DINOv2's tokens beside where ``dino`` is given.

    What it does with the feature maps is what :class:`magic_matcher.dinov2.Dinov2Features` does; aggregation, components, rotations and
    reflections as there.
    """

    def __init__(
        self,
        name: str,
        unet: UNet,
        tokens: int,
        dino: Dinov2Features | None = None,
        aggregation: str = "aligned",
        components: int | None = global_matching.COMPONENTS,
        rotations: int = global_matching.ROTATIONS,
        reflections: bool = True,
    ) -> None:
        self.name, self.size = name, unet.size
        self.aggregation, self.components = aggregation, components
        self._unet, self._dino, self._n = unet, dino, tokens
        self._views = global_matching.Views.all(rotations, reflections)
        self._lock = threading.Lock()

    def key(self) -> str:
        """All that shapes what is kept of a reference."""
        beside = self._dino.key() if self._dino is not None else ""
        text = f"{self._unet.key()} {beside} {self._n} {self._views}"
        return f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"

    def extract(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Feature maps (V, n, n, d) of pictures (V, S, S, 3) uint8 RGB, S = self.size."""
        n = self._n
        found = []
        for picture in pictures:
            with self._lock:
                maps = self._unet.maps(picture)
            # Channel by channel: OpenCV resizes no more than 512 of them together.
            scaled = [np.stack([cv2.resize(plane, (n, n)) for plane in np.moveaxis(m, -1, 0)], axis=-1) for m in maps]
            found.append(scaled[0] if len(scaled) == 1 else np.concatenate([global_matching.unit(m) for m in scaled], axis=-1))
        features = np.stack(found)
        if self._dino is None:
            return features
        side = self._dino.size
        tokens = self._dino.extract(np.stack([cv2.resize(p, (side, side), interpolation=cv2.INTER_AREA) for p in pictures]))
        return np.concatenate(
            [np.sqrt(SHARE) * global_matching.unit(features), np.sqrt(1 - SHARE) * global_matching.unit(tokens)], axis=-1
        ).astype(np.float32)


def dift(weights: str, device: str = devices.AUTO, size: int = 768, draws: int = DIFT_DRAWS, **options: Any) -> DiffusionFeatures:
    """DIFT; ``size`` in pixels, the grid has one token for 16 of them."""
    unet = UNet(weights, device, _size(size), DIFT_STEP, DIFT_BLOCKS, draws)
    return DiffusionFeatures("dift", unet, size // 16, **options)


def sd_dino(weights: str, device: str = devices.AUTO, size: int = 960, tokens: int = 60, **options: Any) -> DiffusionFeatures:
    """SD-DINO; ``weights``: Stable Diffusion's and DINOv2's, a comma between them."""
    diffusion, comma, dino = weights.partition(",")
    if not (diffusion and comma and dino):
        raise MagicError(Code.FEATURE_WEIGHTS, "weights of sd_dino", weights, "Stable Diffusion's and DINOv2's, a comma between them")
    beside = Dinov2Features(dino, device, tokens=tokens)
    unet = UNet(diffusion, device, _size(size), SD_DINO_STEP, SD_DINO_BLOCKS, 1)
    return DiffusionFeatures("sd_dino", unet, tokens, beside, **options)


def _size(size: int) -> int:
    if size % 64 or not 64 <= size <= 2048:
        raise MagicError(Code.BAD_REQUEST, "side of the pictures of a U-Net", size, "a multiple of 64 from 64 to 2048 pixels")
    return size
