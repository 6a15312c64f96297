"""What a feature backend is: the global stage behind one interface.

A backend looks at the reference once (:meth:`Features.prepare`, cached by the caller)
and then proposes contact points on any number of new tools.  Which there are says
:mod:`magic_matcher.features`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView
from magic_core.strategy import Strategy
from magic_matcher import contour as contours
from magic_matcher import curvature
from magic_matcher.contour import Contour

#: A tool that is led across its contact's normal by more than this share of its way along it is not led straight on.
ACROSS = 0.25


@dataclass(frozen=True)
class Reference:
    """The demonstration's contact as the backends see it.

    Attributes
    ----------
    pixel, normal : (2,) on the tool's contour in ``view``, and (2,) unit, outward.
    concave, radius : its sign, and its radius of curvature, px.
    target_radius : px of ``view``, of the object touched there (the target's curvature at p_O); ``None`` where it is unknown.
    contour : of view.mask.
    let_go : the tool stays at the target, held by it alone.
    straight : it is led along the contact's normal as long as it acts on the target.
    """

    view: CanonicalView
    pixel: NDArray[np.float64]
    normal: NDArray[np.float64]
    concave: bool
    radius: float
    target_radius: float | None
    contour: Contour
    let_go: bool = False
    straight: bool = True

    def key(self) -> str:
        """A name for everything in here that shapes features, for caches."""
        digest = hashlib.sha256()
        for array in (self.view.image, self.view.mask, self.pixel, self.normal):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(f"{self.view.metres_per_pixel!r} {self.concave} {self.target_radius!r}".encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class Proposal:
    """A place on the new tool that looks like the reference contact.

    pixel (2,); rotation (radians, 0..2 pi) and flipped as in ContactCandidate: a picture
    direction d of the reference view appears as R(rotation) F d, F mirroring u where
    flipped, R turning u towards v; similarity is s_dino, 1 for the reference itself.
    """

    pixel: NDArray[np.float64]
    rotation: float
    flipped: bool
    similarity: float


@dataclass(frozen=True)
class GlobalMatch:
    """Proposals, best first and apart from each other; heatmap (H, W) float32 in 0..1, 0 off the object."""

    proposals: tuple[Proposal, ...]
    heatmap: NDArray[np.float32] | None = field(default=None)


class Features(Protocol):
    """The global stage of the matcher.

    floor: the similarity below which a place is no analogy, 0 where the scale of the similarity is not known; clear: that from which on
    a match in the view of a tool as it stands needs no other view to be looked at, ``inf`` where that is not known.
    """

    name: str
    floor: float
    clear: float

    def key(self) -> str:
        """A name for everything about this backend that shapes what it prepares, for caches."""
        ...

    def prepare(self, reference: Reference) -> Any:
        """Whatever the backend wants to keep of the reference; picklable."""
        ...

    def propose(
        self, prepared: Any, view: CanonicalView, contour: Contour, target_radius: float | None, count: int, heatmap: bool = False
    ) -> GlobalMatch:
        """The ``count`` best places on the tool of ``view``; target_radius in its pixels."""
        ...


def mirrored(direction: NDArray[np.float64], flipped: bool) -> NDArray[np.float64]:
    """F d: picture vectors (..., 2) with u mirrored where flipped."""
    return direction * np.array([-1.0, 1.0]) if flipped else direction


def rotation_between(reference: NDArray[np.float64], found: NDArray[np.float64], flipped: bool) -> float:
    """The rotation in 0..2 pi with found = R(rotation) F reference, for picture directions (2,)."""
    u, v = mirrored(np.asarray(reference, dtype=float), flipped)
    return float((np.arctan2(found[1], found[0]) - np.arctan2(v, u)) % (2 * np.pi))


def suppress(points: NDArray[np.float64], scores: NDArray[np.float64], distance: float, count: int) -> list[int]:
    """Indices of the best ``count`` points (N, 2) of which no two are nearer than ``distance``, best first."""
    chosen: list[int] = []
    scores = np.where(np.isfinite(scores), scores, -np.inf).copy()
    while len(chosen) < count and len(scores):
        best = int(np.argmax(scores))
        if not np.isfinite(scores[best]):
            break
        chosen.append(best)
        scores[np.hypot(*(points - points[best]).T) < distance] = -np.inf
    return chosen


def make_reference(
    view: CanonicalView,
    pixel: NDArray[np.float64],
    normal: NDArray[np.float64] | None = None,
    target_radius: float | None = None,
    contour: Contour | None = None,
) -> Reference:
    """A reference from a view and a point on it; normal, sign and radius are measured there.

    ``POINT_OUTSIDE`` where the point is off the picture or farther from the edge of the object than a tenth of its size.
    """
    contour = contours.extract(view.mask) if contour is None else contour
    pixel = np.asarray(pixel, dtype=float)
    height, width = view.mask.shape
    if pixel.shape != (2,) or not np.all(np.isfinite(pixel)) or not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
        raise MagicError(Code.POINT_OUTSIDE, "reference point", pixel.tolist(), f"u in 0..{width - 1}, v in 0..{height - 1}")
    index = contour.nearest(pixel)
    away = float(np.hypot(*(contour.points[index] - pixel)))
    if away > 0.1 * contour.size:
        raise MagicError(
            Code.POINT_OUTSIDE,
            "distance of the reference point from the object's edge",
            f"{away:.1f} px",
            f"at most {0.1 * contour.size:.1f} px",
        )
    found = curvature.estimate(contour, index)
    return Reference(
        view,
        found.point,
        found.normal if normal is None else np.asarray(normal, dtype=float),
        found.concave,
        found.radius,
        target_radius,
        contour,
    )


def from_strategy(strategy: Strategy) -> Reference:
    """The reference of a strategy: its tool's view and contact, and the target's radius at p_O where it is round there."""
    disc = strategy.target_contact.disc_radius
    radius = None if disc is None else disc / strategy.tool_view.metres_per_pixel
    made = make_reference(strategy.tool_view, strategy.tool_contact.pixel, strategy.tool_contact.normal, radius)
    led = np.array([w.offset for w in strategy.waypoints if w.phase in ("contact", "goal") and not w.contact]).reshape(-1, 3)
    along, *across = np.ptp(led, axis=0) if len(led) else np.zeros(3)
    return replace(made, let_go=strategy.releases, straight=bool(np.hypot(*across) <= ACROSS * along))
