"""A run as a recording for the rerun viewer: the cameras' pictures, what was reconstructed, and the motion in the plan's own time.

An optional extra: ``pip install --no-deps -r ros2_ws/requirements-rerun.txt``; then ``rerun run.rrd`` shows it.

Entities: ``cameras/TOPIC``, ``world/objects/ID`` (the tool moves), ``world/way`` (of the tool), ``world/robot/LINK`` where the arm's
joints are those of the default robot, ``film``, ``verdict``.  Timeline ``motion``, in seconds from the plan's begin.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_bringup.record import Record
from magic_bringup.run_bag import PERIOD, joints_at
from magic_core import conversions
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.robot import Description
from magic_core.robot_pictures import link_mesh

#: Of the recording, in the folder of a run.
NAME = "run.rrd"


def rerun() -> Any:
    """The package; raises BAD_REQUEST where it is not installed."""
    try:
        import rerun as package
    except ImportError as error:
        raise MagicError(
            Code.BAD_REQUEST, "--rerun", str(error), "the extra: pip install --no-deps -r ros2_ws/requirements-rerun.txt"
        ) from error
    return package


def write(record: Record, folder: Path) -> Path:
    """Write ``run.rrd`` into a run's folder, in place of one that is there; its path."""
    rr, path = rerun(), folder / NAME
    stream = rr.new_recording("magic")
    rr.save(path, recording=stream)

    def log(entity: str, what: Any, static: bool = True) -> None:
        rr.log(entity, what, static=static, recording=stream)

    def placed(entity: str, pose: NDArray[np.float64], static: bool = True) -> None:
        log(entity, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static)

    def shown(mesh: Mesh) -> Any:
        return rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=mesh.colors)

    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log("verdict", rr.TextDocument(f"{record.summary['strategy']}, {record.summary['variant']}: {record.summary['message']}"))
    for topic, message in record.images.items():
        depth = topic.endswith("aligned_depth_to_color/image_raw")
        picture = conversions.depth_from_msg(message) if depth else conversions.color_from_msg(message)
        log(f"cameras/{topic.strip('/')}", rr.DepthImage(picture, meter=1.0) if depth else rr.Image(picture))
    objects = conversions.scene_from_msg(record.scene).objects if record.scene is not None else ()
    plan = record.result.plan if record.result is not None and record.result.plan.tool_trajectory.points else None
    for item in objects:
        log(f"world/objects/{item.id}", shown(item.mesh))
        if plan is None or item.id != record.result.tool_id:
            placed(f"world/objects/{item.id}", item.world_from_object)
    if record.result is not None and len(record.result.film.data):
        log("film", rr.Image(conversions.color_from_msg(record.result.film)))
    if plan is not None:
        motion = conversions.plan_from_msg(plan)
        way = motion.tool_motion.world_from_tool
        log("world/way", rr.LineStrips3D([way[:, :3, 3]]))
        robot, arm = Description(), motion.arm_motion
        links = {}
        if arm is not None and tuple(arm.joint_names) == robot.names:
            links = {link: mesh for link in robot.links if (mesh := link_mesh(robot, link)) is not None}
        for link, mesh in links.items():
            log(f"world/robot/{link}", shown(mesh))
        times = motion.tool_motion.times
        for when in np.arange(times[0], times[-1] + PERIOD, PERIOD):
            rr.set_time_seconds("motion", when, recording=stream)
            placed(f"world/objects/{record.result.tool_id}", way[int(np.abs(times - when).argmin())], static=False)
            if links:
                poses = robot.poses(robot.arm_positions(joints_at(robot, arm, when)))
                for link in links:
                    placed(f"world/robot/{link}", poses[link], static=False)
    rr.disconnect(recording=stream)
    return path
