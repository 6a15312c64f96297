"""Labelled pairs of procedural shapes: what a right answer is, for training, tests and the bench.

A job names, for each family of shapes, the regions made for it, and the sizes of the
targets it is done to.  Where a contact would *work* is decided for the tool and the
target at hand: in a pull the disc must find room and be held while the tool moves
along the contact's normal; hung, the tool must not be able to fall off the disc.  This
admits places nobody marked (the outer V of open scissors) and rejects marked ones that are too
narrow (a finger ring for a thick cylinder).  A bowl is where the generator made it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import shapes
from magic_core.contact import Contact, contact_frame
from magic_core.scene import CanonicalView
from magic_matcher import contour as contours
from magic_matcher import holding
from magic_matcher.contour import Contour
from magic_matcher.targets import Target


@dataclass(frozen=True)
class Job:
    """view: kind of canonical view; regions: of each family, those that do the job ('*' at the end: all that begin so);
    targets: least and greatest radius (m) of what it is done to; references: families of the demonstration and their regions;
    needs: ``press`` (held while the tool moves along the normal), ``swing`` (the tool hangs safely) or ``region``."""

    name: str
    view: str
    regions: Mapping[str, tuple[str, ...]]
    targets: tuple[float, float]
    references: Mapping[str, str]
    needs: str = "region"


JOBS: dict[str, Job] = {
    "hooking": Job(
        "hooking",
        "top",
        {
            "l_hook": ("inner",),
            "j_hook": ("inner",),
            "s_hook": ("upper", "lower"),
            "letter": ("concave_*",),
            "hammer": ("neck_*",),
            "hanger": ("hook", "hook_side"),
            "scissors": ("crotch", "ring_*"),
            "caliper": ("jaw", "slider", "slider_back"),
            "watch": ("band",),
        },
        (0.015, 0.035),
        {"l_hook": "inner", "j_hook": "inner"},
        "press",
    ),
    "hanging": Job(
        "hanging",
        "side",
        {
            "hanger": ("hook",),
            "j_hook": ("inner",),
            "s_hook": ("upper", "lower"),
            "scissors": ("ring_*",),
            "watch": ("band",),
            "mug": ("handle", "handle_loop"),
        },
        (0.004, 0.009),
        {"hanger": "hook"},
        "swing",
    ),
    "scooping": Job(
        "scooping",
        "section",
        {"spoon": ("bowl", "bowl_inside"), "ladle": ("bowl", "bowl_inside"), "measuring_cup": ("bowl", "bowl_inside")},
        (0.015, 0.045),
        {"spoon": "bowl"},
    ),
}

#: What counts as held: standing off from the contact, sliding before it rests (half a radius is the drift that a pull may
#: have), and the depth of the hollow, in radii.
GAP, DRIFT, DEPTH = 0.6, 0.5, 0.3


@dataclass(frozen=True)
class Example:
    """A shape drawn for matching: its view, contour, and the places that do the job.

    :meth:`near` and :meth:`works` say which of them do.
    """

    shape: shapes.Shape
    view: CanonicalView
    contour: Contour
    job: Job
    true: Contour

    def names(self) -> list[str]:
        """The shape's regions that do the job."""
        patterns = self.job.regions[self.shape.family]
        return [n for n in self.shape.regions if any(n == p or (p.endswith("*") and n.startswith(p[:-1])) for p in patterns)]

    def contact(self, name: str) -> Contact:
        """The contact in the middle of a region."""
        return self.shape.contact(name, self.view)

    def near(self, points: NDArray[np.float64], normals: NDArray[np.float64], tolerance: float, share: float = 1.0) -> NDArray[np.bool_]:
        """Which picture points (N, 2) with normals lie within ``tolerance`` px of a region, or of the middle ``share`` of it, with normals
        within 60 degrees."""
        result = np.zeros(len(points), bool)
        for name in self.names():
            region = self.shape.region(name)
            count = len(region.points)
            margin = int(round(0.5 * (1 - share) * (count - 1)))
            pixels = self.view.pixels(region.points[margin : count - margin])
            picture = region.normals[margin : count - margin] @ self.view.object_from_view[:3, :2]
            gap = np.hypot(*(points[:, None] - pixels[None]).transpose(2, 0, 1))
            nearest = np.argmin(gap, axis=1)
            # Between the region's own samples the distance is that to the polyline.
            distance = gap.min(axis=1)
            if len(pixels) > 1:
                a, b = pixels[:-1], pixels[1:]
                d = b - a
                t = np.clip(np.einsum("nki,ki->nk", points[:, None] - a, d) / np.maximum(np.einsum("ki,ki->k", d, d), 1e-12), 0, 1)
                distance = np.linalg.norm(points[:, None] - (a + t[..., None] * d), axis=2).min(axis=1)
            result |= (distance <= tolerance) & (np.sum(normals * picture[nearest], axis=1) > 0.5)
        return result

    def admits(self, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
        """Which contacts (N, 2) have room before them for a disc of ``radius`` px (nine tenths of it, to be fair to narrow fits)."""
        margin = int(np.ceil(2 * radius)) + 2
        room = cv2.distanceTransform((~np.pad(self.view.mask, margin)).astype(np.uint8), cv2.DIST_L2, 5)
        v, u = np.nonzero(room >= 0.9 * radius)
        centres = np.column_stack([u, v])[::7] - margin
        result = np.zeros(len(points), bool)
        for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
            offset = centres - point
            distance = np.hypot(*offset.T)
            result[i] = bool(np.any((distance < 1.6 * radius) & (offset @ normal > 0.75 * distance)))
        return result

    def works(self, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
        """Which contacts (N, 2) with outward normals would do the job with a target of ``radius`` px."""
        if self.job.needs == "region":
            right = self.near(points, normals, self.contour.size / 50)
            right[right] = self.admits(points[right], normals[right], radius)
            return right
        return holds(self.job, self.true, points, normals, radius)

    def held(self, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float) -> holding.Held:
        """Press discs against contacts, on the outline as it truly is."""
        return holding.hold(self.true, points, normals, radius)


def holds(job: Job, true: Contour, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
    """Which contacts (N, 2) of an outline hold a disc of ``radius`` px as a job needs it: pressed, or hung."""
    held = holding.hold(true, points, normals, radius)
    if job.needs == "press":
        return (held.gap <= GAP) & (held.drift <= DRIFT) & (held.press[:, 0] >= DEPTH)
    return (held.gap <= GAP) & (held.start >= DEPTH)


def roughen(mask: NDArray[np.bool_], seed: int) -> NDArray[np.bool_]:
    """A mask as a camera and a segmentation leave it: corners rounded, the edge wavy by a pixel or two, a little too large or too small."""
    random = np.random.default_rng([seed, 77])
    noise = cv2.GaussianBlur(random.standard_normal(mask.shape).astype(np.float32), (0, 0), random.uniform(2.0, 5.0))
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), random.uniform(1.0, 2.2))
    soft += noise * (0.12 / max(float(noise.std()), 1e-9)) * (np.abs(soft - 0.5) < 0.45)
    return soft > random.uniform(0.38, 0.58)


@lru_cache(maxsize=1024)
def example(job: str, family: str, seed: int, rough: bool = False) -> Example:
    """A drawn shape of a family for a job; rough: seen as :func:`roughen` has it."""
    shape = shapes.make(family, seed)
    view = shape.view(JOBS[job].view)
    true = contours.extract(view.mask)
    if not rough:
        return Example(shape, view, true, JOBS[job], true)
    mask = roughen(view.mask, seed)
    view = CanonicalView(
        np.where(mask[..., None], view.image, 0).astype(np.uint8), mask, view.metres_per_pixel, view.object_from_view, view.kind
    )
    return Example(shape, view, contours.extract(mask), JOBS[job], true)


def usable(tool: Example, radius: float) -> bool:
    """Whether any place on the tool would do the job for a disc of ``radius`` px: a tool that cannot is no test."""
    contour = tool.true
    return bool(tool.works(contour.points[::3], contour.normals[::3], radius).any())


def disc_target(radius: float, kind: str) -> Target:
    """A round target of ``radius`` metres with its contact, as the matcher takes it."""
    size = 101
    v, u = np.mgrid[0:size, 0:size] - (size - 1) / 2
    mask = np.hypot(u, v) <= 40
    view = CanonicalView(np.where(mask[..., None], 180, 0).astype(np.uint8).repeat(3, axis=2), mask, radius / 40, np.eye(4), kind)
    normal = np.array([1.0, 0.0])
    pixel = np.array([(size - 1) / 2 + 40, (size - 1) / 2])
    return Target("", view, Contact(pixel, normal, radius, False, 1.7 * radius, contact_frame(view, pixel, normal)))
