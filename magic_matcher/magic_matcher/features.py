"""The feature backends there are, by name; what one is says :class:`magic_matcher.global_stage.Features`.

``embedded`` ships with the package; ``dinov2`` needs weights, ``dift`` and ``sd_dino`` (:mod:`magic_matcher.diffusion`) diffusers as well.
``auto`` takes ``dinov2`` where weights are named and the embedded one everywhere else.  Another backend is added by an entry of
:data:`MAKERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from magic_core import devices
from magic_core.errors import Code, MagicError
from magic_matcher.embedded import EmbeddedFeatures
from magic_matcher.global_stage import Features, from_strategy, make_reference


def _embedded(weights: str, device: str, **options: Any) -> Features:
    return EmbeddedFeatures(**options)


def _dinov2(weights: str, device: str, **options: Any) -> Features:
    from magic_matcher.dinov2 import Dinov2Features

    if not weights:
        raise MagicError(
            Code.FEATURE_WEIGHTS,
            "weights",
            weights,
            "a hub name such as facebook/dinov2-base, or a folder with config.json and model.safetensors",
        )
    folder = Path(weights).expanduser()
    if folder.is_dir():
        return Dinov2Features(str(folder), device, **options)
    if weights.startswith(("/", ".", "~")) or weights.count("/") > 1:  # no hub name looks like this
        raise MagicError(Code.FEATURE_WEIGHTS, "weights", weights, "a folder that exists, or a hub name such as facebook/dinov2-base")
    return Dinov2Features(weights, device, **options)


def _diffusion(name: str) -> Any:
    def made(weights: str, device: str, **options: Any) -> Features:
        from magic_matcher import diffusion

        if not weights:
            raise MagicError(Code.FEATURE_WEIGHTS, "weights", weights, "a hub name or a folder of a Stable Diffusion pipeline")
        found: Features = getattr(diffusion, name)(weights, device, **options)
        return found

    return made


#: Makers of backends by name: weights (hub name or folder, may be empty), torch device, and options of their own; others may be added.
MAKERS: dict[str, Callable[..., Features]] = {
    "embedded": _embedded,
    "dinov2": _dinov2,
    "dift": _diffusion("dift"),
    "sd_dino": _diffusion("sd_dino"),
}
BACKENDS = ("auto", *MAKERS)


def load(name: str = "auto", weights: str = "", device: str = devices.AUTO, **options: Any) -> Features:
    """A backend by name; raises ``UNKNOWN_FEATURES`` or ``FEATURE_WEIGHTS`` saying what was looked for."""
    if name == "auto":
        name = "dinov2" if weights else "embedded"
    if name not in MAKERS:
        raise MagicError(Code.UNKNOWN_FEATURES, "features", name, ("auto", *MAKERS))
    return MAKERS[name](weights, device, **options)


#: With :func:`load`, what a match begins with.
__all__ = ["BACKENDS", "MAKERS", "Features", "from_strategy", "load", "make_reference"]
