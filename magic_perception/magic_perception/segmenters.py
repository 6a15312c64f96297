"""The segmenters by name.  They know the ``depth`` segmenter, which they build on; it knows none of them."""

from __future__ import annotations

from collections.abc import Callable

from magic_core import devices
from magic_core.errors import Code, MagicError
from magic_core.workers import Workers
from magic_perception.segmentation import DepthSegmenter, Segmenter


def _depth(_weights: str, _device: str, workers: Workers | None) -> Segmenter:
    return DepthSegmenter(workers=workers)


def _segment_anything(name: str) -> Callable[[str, str, Workers | None], Segmenter]:
    def make(weights: str, device: str, workers: Workers | None) -> Segmenter:
        from magic_perception.sam import SamSegmenter  # torch is loaded only where it is asked for

        return SamSegmenter(name, weights, device, workers)

    return make


#: Name -> its maker, which is told weights (a hub name or a local folder; empty: its default), torch device, and the processes that help.
MAKERS: dict[str, Callable[[str, str, Workers | None], Segmenter]] = {
    "depth": _depth,
    "sam2": _segment_anything("sam2"),
    "sam": _segment_anything("sam"),
}
SEGMENTERS = tuple(MAKERS)


def make_segmenter(name: str, weights: str = "", device: str = devices.AUTO, workers: Workers | None = None) -> Segmenter:
    """The segmenter of that name; raises ``UNKNOWN_SEGMENTER``, or ``SEGMENTER_WEIGHTS`` where its weights cannot be loaded."""
    if name not in MAKERS:
        raise MagicError(Code.UNKNOWN_SEGMENTER, "segmenter", name, SEGMENTERS)
    return MAKERS[name](weights, device, workers)
