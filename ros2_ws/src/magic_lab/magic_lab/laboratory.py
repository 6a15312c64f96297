"""The laboratory without its topics: a world, the controllers that drive its arm, what happens in it.  No ROS here.

:class:`Lab` goes on by ticks of 10 ms.  Everything is a function of scenario, seed and the goals that come, and of when they come.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.robot import Description
from magic_lab.controllers import Error, GripperController, GripperGoal, TrajectoryController
from magic_lab.scenarios import BLOCK, HAND, NUDGE, SLIP, SLIP_TURN, Event, Scene, actors, hand_pose
from magic_lab.world import SETTINGS, LabWorld
from magic_verifier.simulation import DYNAMIC

Array = NDArray[np.float64]

#: s of a tick, and the engine's steps in it.
TICK = 0.01
STEPS = round(TICK * SETTINGS.frequency)
#: N of each finger where a goal names no effort.
EFFORT = 60.0
#: The fingers' speed is that of the last so many seconds.
TREMBLE = 0.05
#: What the arm's sensors tell of its torques is off by so much, Nm (standard deviation), and no more the same after so many seconds.
TORQUE_ERROR, TORQUE_MEMORY = 0.15, 2.0
#: How far before the hand what blocks it is put, m, from middle to middle.
AHEAD = 0.16


@dataclass
class Silent:
    """What says nothing any more: the first camera, joint_states."""

    camera: bool = False
    joints: bool = False


class Lab:
    """One scene from its reset on.

    world, arm, gripper: physics and controllers.  moves: trajectories begun since the reset.  happened: events that have been;
    put: where they have put things, by name.
    """

    def __init__(self, scene: Scene, robot: Description, events: tuple[Event, ...] = (), allow_stalling: bool = False) -> None:
        events = (*scene.scenario.events, *events)
        self.scene = actors(scene, events)
        self.robot = robot
        self.world = LabWorld(self.scene.things, robot, scene.table_friction, scene.pad_friction)
        self._rng = np.random.default_rng([scene.seed, 15])
        self._sensors = np.random.default_rng([scene.seed, 16])
        self._off = TORQUE_ERROR * self._sensors.standard_normal(len(robot.names))
        self._waiting = list(events)
        self.happened: list[Event] = []
        self.put: dict[str, Array] = {}
        self.silent = Silent()
        self.moves = 0
        self._move_began = 0.0
        self._hand_came = -math.inf
        self._ticks = 0
        self._fingers: list[float] = []  # positions, tick by tick
        self.arm = TrajectoryController(robot.names, self.world.arm.joints()[: len(robot.names)])
        self.gripper = GripperController(allow_stalling=allow_stalling)
        self.joints = self.world.joints()

    @property
    def time(self) -> float:
        """Seconds since the reset."""
        return self._ticks * TICK

    def torques(self) -> Array:
        """(J,): what the arm's sensors tell of its joints' torques (forces), Nm (N)."""
        return self.world.efforts() + self._off

    # ------------------------------------------------------------ goals

    def moved(self) -> None:
        """A trajectory has begun."""
        self.moves += 1
        self._move_began = self.time

    def grip(self, position: float, effort: float) -> GripperGoal:
        """Move the fingers to a position of one finger's joint, m; closing, with ``effort`` N (0: the gripper's own)."""
        goal = self.gripper.begin(position, effort, self.time, float(self.joints[0][-1]))
        if goal.closes:
            self.world.close(effort if effort > 0 else EFFORT)
        else:
            self.world.open(self._width(position))
        return goal

    def leave_fingers(self, goal: GripperGoal) -> None:
        """Cancel a goal of the gripper; the fingers stay as they are."""
        if goal is self.gripper.goal:
            self.world.stop_fingers()
        self.gripper.cancel(goal)

    def _width(self, position: float) -> float:
        """Metres between the fingers where their joints are at a position, both alike."""
        way = np.abs(self.robot.opened - self.robot.closed)
        share = (position - self.robot.closed[-1]) / (self.robot.opened[-1] - self.robot.closed[-1])
        return float(self.robot.config.opening - (1 - share) * way.sum())

    # ------------------------------------------------------------ time

    def tick(self) -> None:
        """Go on by :data:`TICK`; raises SIMULATION_EXPLODED."""
        self._happen()
        count = len(self.robot.names)
        for step in range(STEPS):
            q, qd = self.joints
            self.world.step(*self.arm.update(self.time + step * TICK / STEPS, q[:count], qd[:count]))
            self.joints = self.world.joints()
        self._ticks += 1
        kept = math.exp(-TICK / TORQUE_MEMORY)
        self._off = kept * self._off + math.sqrt(1 - kept**2) * TORQUE_ERROR * self._sensors.standard_normal(len(self._off))
        finger = float(self.joints[0][-1])
        self._fingers = [*self._fingers[-round(TREMBLE / TICK) :], finger]
        # A stiff contact makes them tremble.
        self.gripper.update(self.time, finger, (finger - self._fingers[0]) / TREMBLE)
        if self._ticks % 10 == 0:
            self.world.check()

    def _happen(self) -> None:
        for event in list(self._waiting):
            since = self.time if event.move == 0 else self.time - self._move_began
            if self.moves >= event.move and (since >= event.after or self.moves > event.move > 0):
                self._waiting.remove(event)
                self.happened.append(event)
                self._do(event)
        if HAND in self.world.things and self._hand_came > -math.inf:
            pose = hand_pose(self.time - self._hand_came)
            if pose is None:
                self.world.take_away(HAND)
                self._hand_came = -math.inf
            else:
                self.world.move(HAND, pose)

    def _do(self, event: Event) -> None:
        world, target, tool = self.world, self.scene.target, self.scene.tools[0]
        if event.kind == "nudge":
            angle = self._rng.uniform(-np.pi, np.pi)
            pose = world.pose(target)
            pose[:2, 3] += NUDGE * np.array([np.cos(angle), np.sin(angle)])
            world.place(target, pose)
            self.put[target] = pose
        elif event.kind == "take_target" and world.things[target].kind == DYNAMIC:
            world.take_away(target)
        elif event.kind == "take_tool":
            world.take_away(tool)
        elif event.kind == "slip":
            world.slip(transforms.from_rotvec([SLIP_TURN, 0.0, 0.0], [0.0, SLIP, 0.0]))
        elif event.kind == "hand":
            self._hand_came = self.time
            world.place(HAND, hand_pose(0.0))
        elif event.kind == "block":
            world.place(BLOCK, self._in_the_way())
        elif event.kind == "abort":
            self.arm.abort(Error.PATH_TOLERANCE_VIOLATED, "Aborted due to path tolerance violation (as the scenario has it)")
        elif event.kind == "freeze":
            self.silent.camera = True
        elif event.kind == "silence":
            self.silent.joints = True

    def _in_the_way(self) -> Array:
        """Where a box is right before the hand on its way."""
        goal, count = self.arm.goal, len(self.robot.names)
        now = self.joints[0][:count]
        soon = goal.trajectory.sample(self.time - goal.start + 0.5)[0] if goal is not None else now
        here, there = self.robot.forward(np.stack([now, soon]))[:, :3, 3]
        way = there - here
        length = float(np.linalg.norm(way))
        way = way / length if length > 1e-3 else np.array([0.0, 0.0, -1.0])
        return transforms.make(translation=here + AHEAD * way)
