"""The grasp of a tool that is in the hand already."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_planner.collision import solid_pieces
from magic_planner.grasps import Grasp, pad_profiles
from magic_planner.robot import Robot


def grasp_in_hand(robot: Robot, tool: SceneObject, start: NDArray[np.float64]) -> Grasp:
    """How the arm at ``start`` (J,) holds a tool that is where its pose says.

    The width is that of what lies between the pads, as the tool is known.  Raises BAD_REQUEST where nothing does.
    """
    tool_from_tcp = transforms.inverse(tool.world_from_object) @ robot.chain.forward(start[None])[0]
    heights, _ = pad_profiles(robot, tool_from_tcp[None], solid_pieces(tool))
    width = float(heights[0].max(axis=(0, 1)).sum())
    if not width > 0:
        raise MagicError(
            Code.BAD_REQUEST,
            f"{tool.id}, which hangs, between the fingers of the arm at its start",
            "nothing of it",
            "a tool that is in the hand; one that hangs elsewhere cannot be grasped",
        )
    return Grasp(tool_from_tcp, width, 0.0)
