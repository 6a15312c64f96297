"""Labelled pairs of procedural shapes: what a right answer is, for training, tests and the bench.

A job names, for each family of shapes, the regions on which a contact would do it, and
the sizes of the targets it is done to.  The families that the weights are fitted on and
those that they are tested on are different ones.
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
from magic_matcher.contour import Contour
from magic_matcher.matching import Target


@dataclass(frozen=True)
class Job:
    """view: kind of canonical view; regions: of each family, those that do the job ('*' at the end: all that begin so);
    targets: least and greatest radius (m) of what it is done to; references: families of the demonstration."""

    name: str
    view: str
    regions: Mapping[str, tuple[str, ...]]
    targets: tuple[float, float]
    references: Mapping[str, str]


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
    ),
    "scooping": Job(
        "scooping",
        "section",
        {"spoon": ("bowl", "bowl_inside"), "ladle": ("bowl", "bowl_inside"), "measuring_cup": ("bowl", "bowl_inside")},
        (0.015, 0.045),
        {"spoon": "bowl"},
    ),
}

#: Families the weights are fitted on, as tools; every other family of a job is for testing only.
TRAINING = ("l_hook", "j_hook", "s_hook", "letter", "hammer", "spoon")


@dataclass(frozen=True)
class Example:
    """A shape drawn for matching: its view, contour, and the places that do the job.

    right (N,) bool says which contour points lie on one of the regions with a normal
    that agrees, and, where ``target`` (m) is given, admit a disc of that radius.
    """

    shape: shapes.Shape
    view: CanonicalView
    contour: Contour
    job: Job

    def names(self) -> list[str]:
        """The shape's regions that do the job."""
        patterns = self.job.regions[self.shape.family]
        return [n for n in self.shape.regions if any(n == p or (p.endswith("*") and n.startswith(p[:-1])) for p in patterns)]

    def contact(self, name: str) -> Contact:
        """The contact in the middle of a region."""
        return self.shape.contact(name, self.view)

    def near(self, points: NDArray[np.float64], normals: NDArray[np.float64], tolerance: float, share: float = 1.0) -> NDArray[np.bool_]:
        """Which picture points (N, 2) with normals lie within ``tolerance`` px of a region, or of the middle ``share`` of it, with normals within 60 degrees."""
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


@lru_cache(maxsize=1024)
def example(job: str, family: str, seed: int) -> Example:
    """A drawn shape of a family for a job."""
    shape = shapes.make(family, seed)
    view = shape.view(JOBS[job].view)
    return Example(shape, view, contours.extract(view.mask), JOBS[job])


def usable(tool: Example, radius: float) -> bool:
    """Whether a disc of ``radius`` px finds room at any of the tool's regions: a tool that cannot do the job is no test."""
    contour = tool.contour
    right = tool.near(contour.points[::3], contour.normals[::3], 3.0)
    return bool(tool.admits(contour.points[::3][right], contour.normals[::3][right], radius).any())


def disc_target(radius: float, kind: str) -> Target:
    """A round target of ``radius`` metres with its contact, as the matcher takes it."""
    size = 101
    v, u = np.mgrid[0:size, 0:size] - (size - 1) / 2
    mask = np.hypot(u, v) <= 40
    view = CanonicalView(np.where(mask[..., None], 180, 0).astype(np.uint8).repeat(3, axis=2), mask, radius / 40, np.eye(4), kind)
    normal = np.array([1.0, 0.0])
    pixel = np.array([(size - 1) / 2 + 40, (size - 1) / 2])
    return Target("", view, Contact(pixel, normal, radius, False, 1.7 * radius, contact_frame(view, pixel, normal)))
