"""A case as the robot meets it: true objects before two cameras, what perception makes of them, and the truth to judge by.

:func:`lay_out` puts the true objects on the table: the target and its fixtures where
the demonstration had them, each tool in a turn drawn by the seed, where nothing else
stands, as it comes to rest.  :func:`capture` looks at them with the model of two
D435 that smear depth past edges and over small holes (:data:`magic_core.sensor.SMEARED`), :func:`perceive` reconstructs them as the
perception node does, and :func:`pair` says which reconstruction is which thing.  Everything after that (match, plan, verify) sees the
reconstructions alone.  :func:`judge` carries the motion out once more, on the true meshes, with a friction and densities that the strategy
does not know: what came of the motion, not what was thought of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.motion import MotionPlan
from magic_core.scene import Scene, SceneObject
from magic_core.sensor import D435, SMEARED, STATION, scene_raycaster
from magic_core.sensor import capture as photograph
from magic_core.strategy import Physics, Strategy
from magic_verifier import placing
from magic_verifier.floating import settled
from magic_verifier.subjects import Case, Meeting, scene_for, tool_object

TABLE = np.array([0.0, 0.0, 1.0, 0.0])
#: Frames of each camera that are averaged: the perception node's default.
FRAMES = 3
#: Where things are laid, lowest and highest x and y, m: within its workspace, and so far from the arm's base that they can be taken up.
LAID = (0.15, -0.6), (0.95, 0.6)
#: A reconstruction belongs to a thing when its middle is nearer than this share of the thing's longest side.
NEAR = 0.35
#: What is truly the case, as factors on the strategy's own numbers: half range of friction, and densities from 1/x to x.
TRUE_FRICTION, TRUE_DENSITY = 0.25, 2.0


@dataclass(frozen=True)
class Layout:
    """What truly stands there: tools in the order of the case, the target, fixtures, and the true physics."""

    tools: tuple[SceneObject, ...]
    target: SceneObject
    fixtures: tuple[SceneObject, ...]
    meeting: Meeting | None
    physics: Physics


def lay_out(strategy: Strategy, case: Case, seed: int) -> Layout:
    """The true scene of a case; the same seed gives the same.  Raises ``BAD_SCENE`` where there is no room for a tool."""
    rng = np.random.default_rng(placing.seed_of(case.name, seed))
    target, fixtures, meeting = scene_for(strategy, case.target)
    physics = replace(
        strategy.physics,
        friction=strategy.physics.friction * float(rng.uniform(1 - TRUE_FRICTION, 1 + TRUE_FRICTION)),
        tool_density=strategy.physics.tool_density * float(TRUE_DENSITY ** rng.uniform(-1, 1)),
        target_density=strategy.physics.target_density * float(TRUE_DENSITY ** rng.uniform(-1, 1)),
    )
    tools = []
    for index, name in enumerate(case.tools):
        tool = tool_object(name, index, strategy.view)
        tools.append(settled(placing.turned(tool, float(rng.uniform(-np.pi, np.pi))), TABLE, strategy.physics))
    placed = placing.place_all(tools, (target, *fixtures), rng, _in_sight)
    return Layout(tuple(placed), target, fixtures, meeting, physics)


def _in_sight(item: SceneObject, covered: Any) -> bool:
    """Whether both cameras see all of the object, and it lies where things are laid."""
    import shapely

    region = shapely.box(*np.add(LAID[0], 0.01), *np.subtract(LAID[1], 0.01))
    if not region.contains(covered):
        return False
    corners = transforms.apply(item.world_from_object, item.mesh.vertices)
    for world_from_camera in STATION.values():
        pixels = D435.project(transforms.apply(transforms.inverse(world_from_camera), corners))
        if np.any(pixels < 5) or np.any(pixels > [D435.width - 6, D435.height - 6]):
            return False
    return True


def capture(layout: Layout, case: Case, seed: int) -> list[RgbdFrame]:
    """One frame of each camera, averaged as the perception node averages."""
    from magic_perception.averaging import average

    meshes = [item.mesh.transformed(item.world_from_object) for item in (*layout.tools, layout.target, *layout.fixtures)]
    caster = scene_raycaster(meshes)
    frames = []
    for number, (name, pose) in enumerate(STATION.items()):
        shots = [
            photograph([], D435, pose, [*placing.seed_of(case.name, seed), number, k], camera=name, raycaster=caster, model=SMEARED)
            for k in range(FRAMES)
        ]
        frames.append(average(shots))
    return frames


def perceive(layout: Layout, frames: list[RgbdFrame], physics: Physics) -> Scene:
    """What perception makes of the frames; fixtures, and a target that is one, are known to it."""
    from magic_perception.parameters import WORKSPACE, Parameters
    from magic_perception.pipeline import perceive as reconstruct

    known = layout.fixtures + ((layout.target,) if physics.target_is_fixed else ())
    return reconstruct(frames, known, Parameters(**WORKSPACE))


def pair(layout: Layout, scene: Scene) -> tuple[list[SceneObject | None], SceneObject | None]:
    """The reconstruction of each tool and of the target, as a person would point at them; ``None`` where there is none."""
    left = {item.id: item for item in scene.objects if item.source != "known"}

    def nearest(true: SceneObject) -> SceneObject | None:
        middle = transforms.apply(true.world_from_object, true.mesh.bounds.mean(axis=0))
        near = NEAR * float(true.mesh.extents.max())
        found = min(left.values(), key=lambda o: float(np.linalg.norm(_middle(o) - middle)), default=None)
        if found is None or np.linalg.norm(_middle(found) - middle) > near:
            return None
        return left.pop(found.id)

    known = next((item for item in scene.objects if item.source == "known" and item.id == layout.target.id), None)
    target = known if known is not None else nearest(layout.target)
    return [nearest(tool) for tool in layout.tools], target


def _middle(item: SceneObject) -> NDArray[np.float64]:
    return transforms.apply(item.world_from_object, item.mesh.bounds.mean(axis=0))


def surface_error(true: SceneObject, seen: SceneObject) -> float:
    """How far reconstruction and truth are apart, where they stand: root mean square distance, m, from points on each to the other."""
    from magic_perception.surface_error import distance

    return distance(*(item.mesh.transformed(item.world_from_object) for item in (true, seen)))


def judge(strategy: Strategy, layout: Layout, index: int, seen: SceneObject, plan: MotionPlan, seed: int) -> Any:
    """The verdict of one run with the true tool ``index``, target and fixtures, where ``seen`` is what the plan took the tool for.

    The motion of whatever holds the tool stays as it was planned, so that the true tool is held where it truly is.
    """
    from magic_verifier.rollout import Limits
    from magic_verifier.verification import Proposal, verify_proposal

    true = replace(layout.tools[index], id=seen.id)
    seen_from_true = transforms.inverse(seen.world_from_object) @ true.world_from_object
    motion = replace(plan.tool_motion, world_from_tool=plan.tool_motion.world_from_tool @ seen_from_true)
    arm = plan.arm_motion
    if arm is not None:
        arm = replace(arm, tool_from_tcp=transforms.inverse(seen_from_true) @ arm.tool_from_tcp)
    others = tuple(tool for k, tool in enumerate(layout.tools) if k != index)
    truth = replace(strategy, physics=layout.physics)
    plan = MotionPlan(plan.variant, motion, arm)
    # A real hand gives way as the verifier's drawn rollouts have it.
    limits = Limits().yielding()
    obstacles = (*layout.fixtures, *others)
    return verify_proposal(Proposal(truth, true, layout.target, obstacles, TABLE, plan, seed, limits=limits), repetitions=1)


def sheet(frames: list[RgbdFrame], scene: Scene, path: Any) -> None:
    """A picture of what the first camera saw, the reconstructions drawn on it."""
    frame = frames[0]
    image = frame.color[:, :, ::-1].copy()
    camera_from_world = transforms.inverse(frame.world_from_camera)
    for item in scene.objects:
        corners = transforms.apply(camera_from_world @ item.world_from_object, item.mesh.vertices)
        pixels = np.round(frame.intrinsics.project(corners)).astype(np.int32)
        shade = (0, 200, 80) if item.source != "known" else (200, 160, 0)
        for triangle in item.mesh.faces[:: max(1, len(item.mesh.faces) // 1500)]:
            cv2.polylines(image, [pixels[triangle]], True, shade, 1, cv2.LINE_AA)
        cv2.putText(image, item.id, tuple(int(v) for v in pixels.min(axis=0)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 220), 1, cv2.LINE_AA)
    cv2.imwrite(str(path), image)
