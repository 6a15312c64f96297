"""Markers of a run: every candidate with what became of it, contact frames, the tool's path."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from magic_core import conversions, transforms
from magic_core.errors import Code
from magic_interfaces import msg as mi
from magic_server.pipeline import Report

KEPT = ColorRGBA(r=0.16, g=0.65, b=0.27, a=1.0)
DROPPED = ColorRGBA(r=0.86, g=0.20, b=0.18, a=0.9)
PENDING = ColorRGBA(r=0.95, g=0.77, b=0.06, a=0.9)
PATH = ColorRGBA(r=0.13, g=0.45, b=0.85, a=1.0)
#: How far to either side of a contact its surface's bends are drawn (m).
BEND = 0.008
AXES = (ColorRGBA(r=0.9, a=1.0), ColorRGBA(g=0.8, a=1.0), ColorRGBA(b=0.95, a=1.0))


def _point(values: NDArray[np.float64]) -> Point:
    x, y, z = (float(v) for v in values)
    return Point(x=x, y=y, z=z)


class _Builder:
    def __init__(self, header: Header) -> None:
        # Stamp zero: the markers stand where they stand, whatever the time of the display.
        self._header = Header(frame_id=header.frame_id, stamp=Time())
        self.markers: list[Marker] = [Marker(header=self._header, action=Marker.DELETEALL)]
        self._count: dict[str, int] = {}

    def add(self, ns: str, kind: int, color: ColorRGBA, scale: tuple[float, float, float]) -> Marker:
        marker = Marker(header=self._header, ns=ns, id=self._count.get(ns, 0), type=kind, action=Marker.ADD, color=color)
        marker.pose.orientation.w = 1.0
        marker.scale = Vector3(x=scale[0], y=scale[1], z=scale[2])
        self._count[ns] = marker.id + 1
        self.markers.append(marker)
        return marker

    def axes(self, ns: str, world_from_frame: NDArray[np.float64], length: float) -> None:
        for axis, color in enumerate(AXES):
            marker = self.add(ns, Marker.ARROW, color, (0.003, 0.006, 0.008))
            marker.points = [_point(world_from_frame[:3, 3]), _point(world_from_frame[:3, 3] + length * world_from_frame[:3, axis])]

    def bends(self, ns: str, world_from_surface: NDArray[np.float64], curvatures: NDArray[np.float64]) -> None:
        """The surface along its two principal directions, BEND metres to either side, as far as the curvature tells."""
        away = np.linspace(-BEND, BEND, 13)
        for axis, (curvature, color) in enumerate(zip(curvatures, AXES[1:], strict=True), start=1):
            places = np.zeros((len(away), 3))
            places[:, axis], places[:, 0] = away, -0.5 * curvature * away**2
            line = self.add(ns, Marker.LINE_STRIP, color, (0.001, 0.0, 0.0))
            line.points = [_point(place) for place in transforms.apply(world_from_surface, places)]


def describe(reports: list[Report]) -> tuple[str, ColorRGBA]:
    """One line on what became of a candidate, and its colour."""
    if not reports:
        return "not tried", PENDING
    kept = [r for r in reports if r.code == Code.OK]
    if kept:
        return f"kept ({kept[-1].stage}): {kept[-1].message}"[:120], KEPT
    last = reports[-1]
    return f"dropped at {last.stage}: {last.code.name} {last.message}"[:120], DROPPED


def run_markers(
    scene: mi.SceneObjectArray,
    candidates: list[mi.ContactCandidate],
    target_id: str,
    reports: tuple[Report, ...],
    plan: mi.MotionPlan | None,
) -> MarkerArray:
    """All markers of a run, in the frame of the scene; the first one deletes those of the run before."""
    build = _Builder(scene.header)
    objects = {item.id: item for item in scene.objects}
    for index, candidate in enumerate(candidates):
        if candidate.tool_id not in objects:
            continue
        world_from_tool = conversions.pose_from_msg(objects[candidate.tool_id].pose)
        world_from_contact = world_from_tool @ conversions.pose_from_msg(candidate.tool.object_from_contact)
        text, color = describe([r for r in reports if r.trial.index == index])
        build.add("candidates", Marker.SPHERE, color, (0.012, 0.012, 0.012)).pose.position = _point(world_from_contact[:3, 3])
        label = build.add("reasons", Marker.TEXT_VIEW_FACING, color, (0.0, 0.0, 0.018))
        label.pose.position = _point(world_from_contact[:3, 3] + [0.0, 0.0, 0.05 + 0.025 * index])
        label.text = f"{index + 1}: score {candidate.score:.3f}, {text}"
        build.axes("tool_contacts", world_from_contact, 0.04)
        if candidate.tool.has_surface:
            build.bends(
                "curvatures", world_from_tool @ conversions.pose_from_msg(candidate.tool.object_from_surface), candidate.tool.curvatures
            )
        for further in candidate.companions:
            build.axes("further_contacts", world_from_tool @ conversions.pose_from_msg(further.tool.object_from_contact), 0.03)
        if index == 0 and candidate.has_target and target_id in objects:
            world_from_target = conversions.pose_from_msg(objects[target_id].pose)
            build.axes("target_contact", world_from_target @ conversions.pose_from_msg(candidate.target.object_from_contact), 0.05)
    if plan is not None and plan.tool_trajectory.points:
        _path(build, candidates, reports, plan)
    return MarkerArray(markers=build.markers)


def _path(build: _Builder, candidates: list[mi.ContactCandidate], reports: tuple[Report, ...], plan: mi.MotionPlan) -> None:
    """The way of the tool's contact point through the motion."""
    index = reports[-1].trial.index if reports else 0
    tool_from_contact = conversions.pose_from_msg(candidates[index].tool.object_from_contact) if candidates else np.eye(4)
    points = plan.tool_trajectory.points
    step = max(1, math.ceil(len(points) / 500))
    line = build.add("tool_path", Marker.LINE_STRIP, PATH, (0.004, 0.0, 0.0))
    for row in [*points[::step], points[-1]]:
        pose = conversions.transform_from_msg(row.transforms[0])
        line.points.append(_point(transforms.apply(pose, tool_from_contact[:3, 3])))
