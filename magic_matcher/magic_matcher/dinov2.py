"""DINOv2 and DINOv3 features through transformers, any size, from the hub or a local folder."""

from __future__ import annotations

import hashlib
import threading

import numpy as np
from numpy.typing import NDArray

from magic_core import devices
from magic_core.errors import Code, MagicError
from magic_core.weights import config_of, loading
from magic_matcher import global_matching

MODELS = ("dinov2", "dinov2_with_registers", "dinov3_vit")
PRECISIONS = ("auto", "float32", "bfloat16", "float16")
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)


class Dinov2Features(global_matching.NetworkFeatures):
    """The paper's global stage.

    weights: a hub name or a folder; tokens: side n of the feature map, the picture is then n
    patches wide (37: 518 px at DINOv2's patch of 14); aggregation ``aligned`` or
    ``pairs``; components d' of the joint PCA (``None``: no PCA); precision ``float32``, ``bfloat16``,
    ``float16`` or ``auto``: float32 on the CPU, float16 elsewhere.  All that follows the network is float32.
    The tokens are those of the last block before the final norm.
    """

    name = "dinov2"

    def __init__(
        self,
        weights: str,
        device: str = devices.AUTO,
        tokens: int = 37,
        aggregation: str = "aligned",
        components: int | None = global_matching.COMPONENTS,
        rotations: int = global_matching.ROTATIONS,
        reflections: bool = True,
        precision: str = "auto",
    ) -> None:
        if precision not in PRECISIONS:
            raise MagicError(Code.BAD_REQUEST, "precision", precision, PRECISIONS)
        try:
            import torch
            from transformers import AutoModel
            from transformers.utils import logging
        except ImportError as error:
            raise MagicError(Code.FEATURE_WEIGHTS, "dinov2 features", str(error), "an environment with torch and transformers") from error
        logging.disable_progress_bar()  # a log is no place for it, and an error is one line
        allowed = "a hub name that can be reached, or a folder with config.json and model.safetensors; a torch device of this machine"
        with loading(weights, device, allowed):
            config = config_of(weights, MODELS)
            self._torch = torch
            self._device = torch.device(devices.chosen(device))
            half = "float32" if self._device.type == "cpu" else "float16"
            self._dtype = getattr(torch, half if precision == "auto" else precision)
            self._model = AutoModel.from_pretrained(weights, dtype=self._dtype).to(self._device).eval()
        self._weights = str(weights)
        self._patch = int(config.patch_size)
        self._extra = 1 + int(getattr(config, "num_register_tokens", 0) or 0)
        self.aggregation, self.components = aggregation, components
        self._n, self.size = tokens, tokens * self._patch
        self._views = global_matching.Views.all(rotations, reflections)
        self._lock = threading.Lock()

    def key(self) -> str:
        """Weights (name, and for a folder the files' sizes and times), grid and views: all that shapes what is kept of a reference."""
        text = f"{global_matching.state_of(self._weights)} {self._n} {self._patch} {self._dtype} {self._views}"
        return "dinov2-" + hashlib.sha256(text.encode()).hexdigest()[:24]

    def extract(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Feature maps (V, n, n, d) of pictures (V, S, S, 3) uint8 RGB, S = self.size; a few pictures at a time, to bound memory."""
        torch = self._torch
        maps = []
        with self._lock, torch.inference_mode():
            for start in range(0, len(pictures), 4):
                batch = (pictures[start : start + 4].astype(np.float32) / 255 - _MEAN) / _STD
                pixels = torch.from_numpy(np.ascontiguousarray(batch.transpose(0, 3, 1, 2))).to(self._device, self._dtype)
                # hidden_states[-1] is the last block's output where the model norms after it
                hidden = self._model(pixel_values=pixels, output_hidden_states=True).hidden_states[-1]
                tokens = hidden[:, self._extra :].float().cpu().numpy()
                maps.append(tokens.reshape(len(batch), self._n, self._n, -1))
        return np.concatenate(maps)
