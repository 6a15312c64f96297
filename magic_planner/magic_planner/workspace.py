"""The collision world of one request, in its states: the tool lying, in the hand, left where it was let go."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_planner.cloud import CloudSettings, cloud_name
from magic_planner.grasps import Grasp
from magic_planner.request import Request
from magic_planner.robot import TABLE_GAP, Robot

Array = NDArray[np.float64]
#: The table as it stands for a tool that is carried with room about it.
DEEPER = "table/deeper"


class Workspace:
    """What the arm may touch, and what it may not, as the request proceeds."""

    def __init__(self, robot: Robot, cloud: CloudSettings) -> None:
        self.robot = robot
        self.cloud = cloud

    def build(self, request: Request) -> None:
        """Table, target, obstacles with their clouds, and the tool where it lies; whatever was there before is gone."""
        robot = self.robot
        robot.clear()
        robot.add_table(request.plane)
        self.surround(request, 0.0)
        for item in (request.target, *request.obstacles):
            if item.id in request.cloud:
                robot.add_cloud(cloud_name(item), request.cloud[item.id], self.cloud.resolution)
        robot.add(request.tool.id, request.shapes, request.tool.world_from_object)

    def surround(self, request: Request, room: float) -> None:
        """Target and obstacles where they are, with so much room (m) about them."""
        for item in (request.target, *request.obstacles):
            self.robot.add(item.id, request.roomy(item, room), item.world_from_object)

    def empty(self, request: Request) -> None:
        """The world without the tool, the hand open."""
        robot, name = self.robot, request.tool.id
        robot.detach()
        if robot.world.has_object(name):
            robot.world.remove_object(name)
        robot.open_to(robot.config.opening)

    def hold(self, request: Request, grasp: Grasp, shapes: list[Any] | None = None) -> None:
        """The world with the tool (or other shapes in its frame) in the closed hand; it may touch nothing else yet."""
        robot, name = self.robot, request.tool.id
        robot.detach()
        if robot.world.has_object(name):
            robot.world.remove_object(name)
        robot.open_to(grasp.width)
        if robot.world.has_object(DEEPER):
            robot.world.remove_object(DEEPER)
        robot.attach(name, shapes or request.shapes, transforms.inverse(grasp.tool_from_tcp), tuple(robot.hand))
        robot.allow(name, "table", DEEPER, *request.surroundings(), allowed=False)
        self.ignore_target(request, False)

    def hold_with_room(self, request: Request, grasp: Grasp, room: float, ends: Iterable[Array]) -> None:
        """As :meth:`hold`, the tool with so much room (m) about it.  To the table it needs none, above which the task
        may begin by a hair: it stands that much deeper for the tool, and not at all where the ``ends`` (J,) of the way
        meet even that.  :meth:`hold` undoes it."""
        robot, name = self.robot, request.tool.id
        self.hold(request, grasp, request.roomy(request.tool, room))
        robot.allow(name, "table")
        robot.add_table(request.plane, DEEPER, TABLE_GAP + room)
        robot.allow(name, DEEPER, allowed=any(robot.collides(q) for q in ends))

    def carry_off(self, request: Request, grasp: Grasp) -> None:
        """As :meth:`hold`, and the tool may touch what it leaves, or is led to."""
        self.hold(request, grasp)
        self.robot.allow(request.tool.id, "table", *request.surroundings())

    def lay(self, request: Request, pose: Array, shapes: list[Any] | None = None) -> None:
        """The world with the tool (or other shapes in its frame) lying at a pose and the hand open
        about it; only the fingers may touch it."""
        robot, name = self.robot, request.tool.id
        robot.detach()
        robot.open_to(robot.config.opening)
        robot.add(name, shapes or request.shapes, pose)
        robot.allow(name, *robot.finger_links)
        robot.allow(name, "table", *request.surroundings())
        self.ignore_target(request, False)

    def come(self, request: Request, room: float) -> None:
        """The world of the empty hand on its way to the tool, everything but the table with so much room (m) about it; nothing may be
        touched.  What is set up after it needs ``surround(request, 0.0)`` first."""
        self.surround(request, room)
        self.lay(request, request.tool.world_from_object, request.roomy(request.tool, room))
        self.robot.allow(request.tool.id, *self.robot.finger_links, allowed=False)

    def ignore_target(self, request: Request, ignored: bool) -> None:
        """Let the arm touch the target (once it moves with the tool, where it is is not known any more), or forbid it again."""
        links = list(self.robot.planner.user_link_names)
        self.robot.allow(request.target.id, *links, allowed=ignored)
        if request.target.id in request.cloud:
            self.robot.allow(cloud_name(request.target), *links, allowed=ignored)
