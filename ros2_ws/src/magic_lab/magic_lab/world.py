"""The laboratory's physics: table, things and an arm that is driven by joint targets.  No ROS here.

It is the verifier's engine and its model of a grip (:mod:`magic_verifier.simulation`, :mod:`magic_verifier.articulation`,
:mod:`magic_verifier.grip`), with other things in it: the true ones, each with a density and a friction of its own.  Nothing here knows
what is tool and what is target: fingers that close hold whatever is between them, for as long as friction holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description
from magic_core.scene import SceneObject
from magic_verifier.arm_simulation import LOOK_BACK, STOPPED
from magic_verifier.articulation import FINGERS, ArmOptions, Articulation
from magic_verifier.floating import TABLE, lifted_onto_table
from magic_verifier.floating import Body as Hulls
from magic_verifier.grip import SOFTNESS, Grip, patch_of
from magic_verifier.simulation import DYNAMIC, Settings, World, from_pose, to_pose, usable_pieces

Array = NDArray[np.float64]

#: The engine's settings, as the verifier has them for arms; three steps make one of the joint states' hundredths of a second.
SETTINGS = Settings(frequency=300.0, position_iterations=8, contact_offset=0.002)
#: What the hand holds is looked at every so many steps.
WATCH_EVERY = 6
#: The plane of the table top.
PLANE = np.array([0.0, 0.0, 1.0, 0.0])
#: What has slipped by this (m) or turned by this (rad) since it was gripped is no more between the pads.
LOST, LOST_TURN = 0.03, 1.0
#: Where things are put that are taken away: far behind the arm, m.
AWAY = np.array([-3.0, 0.0, 1.0])


@dataclass(frozen=True)
class Thing:
    """A true object: what it is and where it begins (``item``), whether it is ``dynamic``, ``static`` or ``kinematic`` (moved by the
    scenario), its density in kg/m^3 and its friction coefficient."""

    item: SceneObject
    kind: str = DYNAMIC
    density: float = 600.0
    friction: float = 0.4

    @property
    def name(self) -> str:
        """Its id."""
        return self.item.id


class LabWorld:
    """Things, arm and gripper; :meth:`step` goes on by one step of the engine.

    friction: of table and of finger pads.  Raises BAD_SCENE, BAD_REQUEST (an arm that the engine cannot load).
    """

    def __init__(self, things: Sequence[Thing], robot: Description, table_friction: float = 0.4, pad_friction: float = 1.2) -> None:
        self.things = {thing.name: thing for thing in things}
        if len(self.things) != len(things):
            raise MagicError(Code.BAD_SCENE, "ids of the things", [thing.name for thing in things], "ids that differ")
        self.robot = robot
        self.engine = engine = World(SETTINGS)
        engine.add_table(PLANE, table_friction, TABLE)
        for thing in things:
            pose = np.asarray(thing.item.world_from_object, dtype=float)
            body = Hulls(thing.name, tuple(usable_pieces(thing.name, thing.item.pieces)), pose)
            if thing.kind == DYNAMIC:
                body = lifted_onto_table(body, PLANE)
            engine.add(thing.name, list(body.hulls), body.world_from_object, thing.kind, thing.density, thing.friction, balls=body.balls)
        self._options = ArmOptions(finger_friction=pad_friction)
        self.arm = Articulation(engine, robot, self._options)
        self._closing_axis = "xy".index(robot.config.closing_axis)
        self._grip: Grip | None = None
        self._held = ""
        self._reference = np.eye(4)
        self._force = 0.0  # N with which the fingers close; 0: they do not
        self._pressed = 0.0  # N with which they have closed on what they hold
        self._widths: list[float] = []
        home = np.asarray(robot.config.home, dtype=float)
        self.arm.place(home)
        self.arm.open_fingers()
        self.arm.command(home, np.zeros(len(home)))

    # ------------------------------------------------------------ state

    @property
    def time(self) -> float:
        """Seconds since the beginning."""
        return self.engine.time

    @property
    def held(self) -> str:
        """The name of what the fingers hold; empty: nothing."""
        return self._held

    def pose(self, name: str) -> Array:
        """world_from_object (4, 4)."""
        return self.engine.pose(name)

    def poses(self) -> dict[str, Array]:
        """world_from_object (4, 4) of each thing."""
        return {name: self.engine.pose(name) for name in self.things}

    def joints(self) -> tuple[Array, Array]:
        """Positions and velocities (J + 2,): the arm's joints in rad (m), then the fingers in m."""
        return self.arm.joints(), self.arm.speeds()

    def efforts(self) -> Array:
        """(J,): the torque (force) that each of the arm's joints carries, Nm (N)."""
        return np.asarray(self.arm.transmitted(), dtype=float)

    def tcp(self) -> Array:
        """world_from_tcp (4, 4)."""
        return self.arm.tcp()

    # ------------------------------------------------------------ what acts

    def open(self, width: float) -> None:
        """Let go, and drive the fingers ``width`` metres apart."""
        self.release()
        self._force = 0.0
        self.arm.open_fingers(width)

    def close(self, force: float) -> None:
        """Close the fingers until they hold something between them, and hold it with ``force`` N of each finger."""
        self._force, self._widths = force, []

    def stop_fingers(self) -> None:
        """Leave the fingers where they are."""
        self._force = 0.0
        self.arm.rest_fingers()

    def release(self) -> None:
        """Hold nothing any more; the fingers stay where they are."""
        if self._grip is not None:
            self._grip.open()
            self.arm.lets_go(self.engine.component(self._held))
        self._grip, self._held = None, ""

    def slip(self, moved: Array) -> None:
        """Let what is held slip in the fingers by (4, 4), in the frame of the pads' patch: x across them."""
        if self._grip is not None:
            self._grip.slip(moved)

    def place(self, name: str, pose: Array) -> None:
        """Put a thing somewhere, at rest; what is held is taken out of the hand."""
        if name == self._held:
            self.release()
        self.engine.place(name, pose)

    def move(self, name: str, pose: Array) -> None:
        """Where a kinematic thing shall be after the next step; it pushes what is in its way."""
        self.engine.move_to(name, to_pose(pose))

    def take_away(self, name: str) -> None:
        """Take a thing off the table, out of sight; it stays away."""
        self.place(name, transforms.make(translation=AWAY))
        if self.things[name].kind == DYNAMIC:
            self.engine.component(name).disable_gravity = True

    # ------------------------------------------------------------ stepping

    def step(self, q: Array, qd: Array) -> None:
        """One step with the arm's drives at these positions and velocities (J,)."""
        self.arm.command(q, qd)
        if self._force > 0 and self._grip is None:
            self._close()
        self.engine.step()
        if self._grip is not None and self.engine.steps % WATCH_EVERY == 0:
            self._watch(self._grip)

    def _close(self) -> None:
        self._widths.append(self.arm.width())
        back = round(LOOK_BACK * SETTINGS.frequency)
        if len(self._widths) > back and abs(self._widths[-1] - self._widths[-1 - back]) < STOPPED and self._take():
            return
        self.arm.close_fingers()

    def _take(self) -> bool:
        """Hold what both pads touch; whether there is anything."""
        for name in self.engine.touched_by(FINGERS, SOFTNESS):
            thing = self.things.get(name)
            if thing is None or thing.kind != DYNAMIC:
                continue
            friction = (self._options.finger_friction + thing.friction) / 2  # of a pair, as the engine has it
            tcp = self.tcp()
            touches = self.engine.pressed(name, FINGERS, SOFTNESS, tcp[:3, self._closing_axis])
            patch = patch_of(touches, tcp, self._closing_axis, friction)
            if patch is None:
                continue
            body = self.engine.component(name)
            self._grip = self.arm.grips(body, patch, friction, self._force)
            self._held, self._force, self._pressed = name, 0.0, self._force
            self._reference = transforms.inverse(from_pose(body.entity_pose)) @ self.tcp()
            self.arm.rest_fingers()
            return True
        return False

    def _watch(self, grip: Grip) -> None:
        """Let the pads creep where the load is above what friction holds, and lose what has left them: they go on closing then."""
        grip.load()
        drift = self._reference @ transforms.inverse(self.tcp()) @ self.pose(self._held)
        if np.linalg.norm(drift[:3, 3]) > LOST or transforms.rotation_angle(drift, np.eye(4)) > LOST_TURN:
            self.release()
            self.close(self._pressed)

    def check(self) -> None:
        """Raise SIMULATION_EXPLODED where a free thing is nowhere, too far or too fast."""
        self.engine.check(tuple(name for name, thing in self.things.items() if thing.kind == DYNAMIC))
