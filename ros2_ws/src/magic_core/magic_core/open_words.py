"""Objects named in words that :mod:`magic_core.naming` does not know (``the screwdriver``), by a network that compares pictures with texts.

The network is CLIP or SigLIP through transformers, from a hub or a local folder. It always likes one object best, also where none is
what was asked for, so that being liked best is not enough: the words have to describe the picture better than words that would do for
anything, and clearly better than they describe every other picture. What fails either is refused with the list of objects.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import devices, naming
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.weights import config_of, loading

MODELS = ("clip", "siglip", "siglip2")
#: How captions of the pictures that such networks were trained with begin.
CAPTION = "a photo of {}"
#: What is true of every object on a table: words that say no more than these do not name it.
ANYTHING = ("an object", "a thing on a table", "something")
#: The first object's share among all, by the network's own softmax, from which on it is the one that is
#: meant: four to one against all others.
LEAST_SHARE = 0.8


@dataclass(frozen=True)
class Fit:
    """How well words fit the picture of one object.

    above: by how much they fit better than words that fit anything, in the network's logits; share
    0..1: of this object among all of the scene.
    """

    id: str
    above: float
    share: float

    def __str__(self) -> str:
        return f"{self.id} {100 * self.share:.0f} % ({'+' if self.above >= 0 else ''}{self.above:.1f} against any object)"


class OpenWords:
    """A text-image network. weights: a hub name or a folder; device: see :mod:`magic_core.devices`.

    Raises FEATURE_WEIGHTS where it cannot be loaded.
    """

    def __init__(self, weights: str, device: str = devices.AUTO) -> None:
        try:
            import torch
            from transformers import AutoImageProcessor, AutoModel, AutoTokenizer
            from transformers.utils import logging
        except ImportError as error:
            raise MagicError(
                Code.FEATURE_WEIGHTS, "names in open words", str(error), "an environment with torch and transformers"
            ) from error
        logging.disable_progress_bar()  # a log is no place for it
        allowed = "a hub name that can be reached, or a folder with model, image processor and tokenizer; a torch device of this machine"
        with loading(weights, device, allowed):
            config = config_of(weights, MODELS)
            self._torch = torch
            self._device = torch.device(devices.chosen(device))
            self._model = AutoModel.from_pretrained(weights).to(self._device).eval()
            self._images = AutoImageProcessor.from_pretrained(weights)
            self._tokens = AutoTokenizer.from_pretrained(weights)
        # SigLIP was trained with texts filled up to their full length, and reads shorter ones wrongly.
        self._padding = True if config.model_type == "clip" else "max_length"
        self._lock = threading.Lock()

    def logits(self, texts: Sequence[str], pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
        """How well texts describe pictures (h, w, 3) uint8 RGB: (pictures, texts), in the network's own scale."""
        torch = self._torch
        with self._lock, torch.inference_mode():
            tokens = self._tokens(list(texts), padding=self._padding, truncation=True, return_tensors="pt").to(self._device)
            pixels = self._images(images=[_square(p) for p in pictures], input_data_format="channels_last", return_tensors="pt").to(
                self._device
            )
            return self._model(**tokens, **pixels).logits_per_image.double().cpu().numpy()

    def resolve(self, text: str, objects: Sequence[SceneObject]) -> naming.Reading:
        """The one object that words mean, by its picture.  Raises UNKNOWN_OBJECT where they fit none better than any words would, and
        AMBIGUOUS_OBJECT where several fit alike; both say how well they fit each."""
        if not objects:
            raise MagicError(Code.UNKNOWN_OBJECT, "no object is called", text, "no objects")
        captions = [CAPTION.format(words) for words in (text.strip(), *ANYTHING)]
        ranked = fits([o.id for o in objects], self.logits(captions, [picture(o) for o in objects]))
        looks = {o.id: str(naming.looks(o)) for o in objects}
        listed = "; ".join(f"{looks[fit.id]}: {fit}" for fit in ranked)
        first = ranked[0]
        if first.above <= 0:
            raise MagicError(Code.UNKNOWN_OBJECT, "no object's picture looks like", text, listed)
        if first.share < LEAST_SHARE:
            alike = " and ".join(fit.id for fit in ranked[:2])
            raise MagicError(Code.AMBIGUOUS_OBJECT, f"{alike} are too nearly alike to tell which is called", text, listed)
        return naming.Reading(first.id, f"{text!r} is {looks[first.id]} (by its picture: {first})")


def picture(item: SceneObject) -> NDArray[np.uint8]:
    """What shows an object best to somebody: the camera's picture about it; of a known object, its canonical view."""
    return item.picture if item.picture is not None else item.view.image


def _square(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture filled up to a square by its own border: image processors cut what is longer to one."""
    height, width = picture.shape[:2]
    left, top = max(height - width, 0), max(width - height, 0)
    return cv2.copyMakeBorder(picture, top // 2, top - top // 2, left // 2, left - left // 2, cv2.BORDER_REPLICATE)


def fits(ids: Sequence[str], logits: NDArray[np.float64]) -> list[Fit]:
    """Fits of objects, best first, from logits (objects, 1 + n): of the words, and of n that fit anything."""
    weights = np.exp(logits[:, 0] - logits[:, 0].max())
    above = logits[:, 0] - logits[:, 1:].max(axis=1)
    found = [Fit(o, float(a), float(w)) for o, a, w in zip(ids, above, weights / weights.sum(), strict=True)]
    return sorted(found, key=lambda fit: (-fit.share, fit.id))
