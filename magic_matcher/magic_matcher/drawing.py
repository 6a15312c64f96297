"""Pictures of matches: the contact, its normal, its circle of curvature, the heat map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.contact import Contact
from magic_core.scene import CanonicalView

_SHIFT = 4  # sub-pixel drawing: 1/16 px
CONTACT, CIRCLE, NORMAL, LABEL = (255, 60, 60), (80, 220, 255), (255, 220, 60), (240, 240, 240)
#: How strongly a heat map covers the picture where it is hottest.
STRENGTH = 0.65


def _fixed(value: float) -> int:
    return int(round(float(np.clip(value, -20000, 20000)) * 2**_SHIFT))


def overlay(image: NDArray[np.uint8], heatmap: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The image (H, W, 3) uint8 RGB with a heat map (H, W) in 0..1 over it, transparent where it is 0."""
    colors = cv2.cvtColor(cv2.applyColorMap((np.clip(heatmap, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    share = STRENGTH * np.clip(heatmap * 3, 0, 1)[..., None]
    return np.clip(image * (1 - share) + colors * share, 0, 255).astype(np.uint8)


def draw_match(
    view: CanonicalView, contact: Contact | Sequence[Contact] | None, heatmap: NDArray[np.float32] | None = None
) -> NDArray[np.uint8]:
    """The view's picture (H, W, 3) uint8 RGB with contacts on it, best first: a dot, the normal, the circle of curvature.

    The first is drawn full, the others thin and numbered from 2.
    """
    image = view.image.copy()
    if heatmap is not None and heatmap.shape == view.mask.shape:
        image = overlay(image, heatmap)
    contacts = [] if contact is None else [contact] if isinstance(contact, Contact) else list(contact)
    side = max(view.mask.shape)
    for rank in reversed(range(len(contacts))):
        item = contacts[rank]
        first = rank == 0
        point, normal = np.asarray(item.pixel, dtype=float), np.asarray(item.normal, dtype=float)
        radius = item.radius / view.metres_per_pixel
        if np.isfinite(radius) and radius < 4 * side:
            centre = point + (radius if item.concave else -radius) * normal
            cv2.circle(image, (_fixed(centre[0]), _fixed(centre[1])), _fixed(radius), CIRCLE, 2 if first else 1, cv2.LINE_AA, _SHIFT)
        else:  # a straight edge: its tangent
            along = np.array([-normal[1], normal[0]]) * side
            ends = [(_fixed(p[0]), _fixed(p[1])) for p in (point - along, point + along)]
            cv2.line(image, *ends, CIRCLE, 1, cv2.LINE_AA, _SHIFT)
        tip = point + 0.09 * side * normal
        cv2.arrowedLine(
            image, tuple(int(round(v)) for v in point), tuple(int(round(v)) for v in tip), NORMAL, 2 if first else 1, cv2.LINE_AA, 0, 0.3
        )
        cv2.circle(
            image, (_fixed(point[0]), _fixed(point[1])), _fixed(0.013 * side if first else 0.008 * side), CONTACT, -1, cv2.LINE_AA, _SHIFT
        )
        if not first:
            at = (int(round(point[0] + 0.015 * side)), int(round(point[1] - 0.015 * side)))
            cv2.putText(image, str(rank + 1), at, cv2.FONT_HERSHEY_SIMPLEX, 0.0012 * side, LABEL, 1, cv2.LINE_AA)
    return image


def side_by_side(pictures: Sequence[NDArray[np.uint8]], titles: Sequence[str] = (), height: int = 384) -> NDArray[np.uint8]:
    """Pictures in a row, scaled to one height, each with its title below."""
    columns = []
    for k, picture in enumerate(pictures):
        width = max(1, int(round(picture.shape[1] * height / picture.shape[0])))
        column = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if picture.shape[0] > height else cv2.INTER_LINEAR)
        if titles:
            strip = np.full((24, width, 3), 24, np.uint8)
            cv2.putText(strip, titles[k] if k < len(titles) else "", (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, LABEL, 1, cv2.LINE_AA)
            column = np.concatenate([column, strip])
        columns.append(column)
    return np.concatenate(columns, axis=1)


def sheet(pictures: Sequence[NDArray[np.uint8]], titles: Sequence[str], columns: int, height: int) -> NDArray[np.uint8]:
    """Pictures in rows of ``columns``, each scaled to one height, with its title below."""
    rows = [side_by_side(pictures[k : k + columns], titles[k : k + columns], height) for k in range(0, len(pictures), columns)]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=24) for row in rows])
