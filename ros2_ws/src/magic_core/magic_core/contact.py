"""Contacts: a point on an object's silhouette with its normal and curvature.

The contact frame, the same for tool and target: origin at the contact point, on
the mid-plane of the canonical view or on the mesh's surface, x along the outward normal n (out of the
material), z along the view direction v, y = z cross x.  Two objects touch
squarely when their x axes oppose and their z axes agree, see :data:`OPPOSED`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.scene import CanonicalView
from magic_core.surface import PrincipalFrame

#: target_contact_from_tool_contact when the two surfaces touch squarely: half a turn about z.
OPPOSED = np.diag([-1.0, -1.0, 1.0, 1.0])

#: A round contact's scale is 1 to 4 times its radius; an edge is one that is so much less than its scale.
SHARP = 0.2


@dataclass(frozen=True)
class Contact:
    """One contact point on one object (p_T or p_O of the paper).

    Attributes
    ----------
    pixel : (2,) float (u, v) in the canonical view.
    normal : (2,) unit, outward, in picture coordinates (u right, v down).
    radius : r of curvature, m; inf on a straight edge.
    concave : the centre of curvature lies outside the material.
    scale : the motion functional scale s_j, m.
    object_from_contact : (4, 4); its origin is as deep along z as the surface is where the mesh is known, else on the view's plane.
    surface : the point of the mesh with its normal and both principal curvatures; ``None`` where there is no mesh or it has an edge there.
    """

    pixel: NDArray[np.float64]
    normal: NDArray[np.float64]
    radius: float
    concave: bool
    scale: float
    object_from_contact: NDArray[np.float64]
    surface: PrincipalFrame | None = None

    @property
    def disc_radius(self) -> float | None:
        """r where a disc stands for what is met there, m; ``None`` on a straight side, in a hollow, and where an edge or a corner is met:
        rounded by less than :data:`SHARP` of the scale at which it is."""
        return self.radius if np.isfinite(self.radius) and not self.concave and self.radius >= SHARP * self.scale else None

    @property
    def signed_curvature(self) -> float:
        """kappa = 1 / r in 1/m, positive where convex, negative where concave."""
        return (-1.0 if self.concave else 1.0) / self.radius


@dataclass(frozen=True)
class Companion:
    """A further contact of a candidate: its name in the strategy, where it is on the tool, and the
    contact on the target that it would meet."""

    name: str
    tool: Contact
    target: Contact | None


@dataclass(frozen=True)
class ContactCandidate:
    """A proposed contact on a new tool, with the contact on the target that it would meet.

    Attributes
    ----------
    rotation, flipped : the in-plane turn of the reference view (rad, 0..2 pi), and whether it was mirrored, under which the reference
    looked
        most like the new tool.
    s_dino, s_curv, score : the global score, the local one, and their combination.
    tool_from_reference : (4, 4), carries the reference tool's frame onto the new tool's frame by aligning the contact frames.
    companions : the further contacts of a strategy with several, in its order; score is then that of all together.
    turn : rad, by which target's contact and motion are turned about the vertical from how the strategy has them, as something stands in
        the way of that.
    """

    tool_id: str
    tool: Contact
    target: Contact | None
    rotation: float
    flipped: bool
    s_dino: float
    s_curv: float
    score: float
    tool_from_reference: NDArray[np.float64]
    companions: tuple[Companion, ...] = ()
    turn: float = 0.0


def contact_frame(view: CanonicalView, pixel: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """object_from_contact (4, 4) of a pixel (2,) and an outward picture normal (2,)."""
    return transforms.frame(view.points(pixel), view.directions(normal), view.direction)


def turned_over(object_from_contact: NDArray[np.float64]) -> NDArray[np.float64]:
    """The contact frame seen from behind: half a turn about the normal.

    A mirrored match is met exactly by turning the tool over; x stays, y and z flip.
    """
    return object_from_contact @ np.diag([1.0, -1.0, -1.0, 1.0])
