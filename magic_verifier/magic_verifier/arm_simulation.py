"""The arm run: the Panda takes the tool and follows the planned joint trajectory (paper, Table I: Arm).

The arm is an articulation with PD joint drives, gravity and Coriolis torques fed
forward, and the effort limits of its URDF, as a position-controlled Panda has.
The tool is a free body from the start and is held by nothing but the friction of
the fingers.
"""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_verifier.floating import CONTACT_PHASES, TABLE, TARGET, TOOL, Setup, fill_world, lifted_onto_table, phase_at, phase_start
from magic_verifier.panda import ARM_JOINTS, FINGER_JOINTS, FINGER_LINKS, TCP_LINK, Panda
from magic_verifier.simulation import DYNAMIC, from_pose

ARM = "arm"
FINGERS = "fingers"
#: The fixed foot of the arm, which may well stand on the table.
BASE = "base"
#: Tracking, torque, contacts and grasp are looked at every so many steps.
WATCH_EVERY = 6


@dataclass(frozen=True)
class ArmOptions:
    """Controller and gripper.

    stiffness Nm/rad and damping Nms/rad of the arm's joint drives, one for each joint (the
    defaults are those of Franka's joint impedance controller, near critical damping);
    armature kg m^2 is what the geared motors add to each joint's inertia; grip_force N of each
    finger; finger_stiffness N/m couples the two fingers, which a belt does in the real
    hand; closing_speed m/s of each free finger;
    opening m between the open fingers; quiet s for which the fingers must stand still
    before the arm goes on, closing_time s after which it goes on anyway.
    """

    stiffness: tuple[float, ...] = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)
    damping: tuple[float, ...] = (120.0, 120.0, 100.0, 100.0, 60.0, 40.0, 30.0)
    armature: float = 0.1
    grip_force: float = 60.0
    finger_stiffness: float = 1e4
    closing_speed: float = 0.1
    finger_friction: float = 1.5
    opening: float = 0.08
    quiet: float = 0.1
    closing_time: float = 1.5

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            values = tuple(float(v) for v in getattr(self, name))
            if len(values) != len(ARM_JOINTS) or not all(np.isfinite(v) and v > 0 for v in values):
                raise MagicError(Code.BAD_REQUEST, f"arm {name}", values, f"{len(ARM_JOINTS)} numbers above 0")
            object.__setattr__(self, name, values)


class ArmRun:
    """One run of an arm plan; :meth:`advance` steps it once.

    ``time`` is the clock of the planned trajectory, which stands still while the
    gripper closes; ``world.time`` goes on.
    """

    variant = "arm"

    def __init__(self, setup: Setup, plan: MotionPlan, options: ArmOptions | None, limits: Any) -> None:
        motion = plan.arm_motion
        if motion is None:
            raise MagicError(Code.BAD_MOTION, "plan", "without an arm motion", "an arm motion")
        positions = np.asarray(motion.positions, dtype=float)
        times = np.asarray(motion.times, dtype=float)
        if tuple(motion.joint_names) != ARM_JOINTS or positions.shape != (len(times), len(ARM_JOINTS)) or len(times) < 2:
            raise MagicError(
                Code.BAD_MOTION, "arm motion", f"{len(times)} rows of {list(motion.joint_names)}", f"two rows or more of {list(ARM_JOINTS)}"
            )
        if not (np.all(np.isfinite(positions)) and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0)):
            raise MagicError(Code.BAD_MOTION, "arm motion", "times or positions", "finite positions at strictly increasing times")
        self.setup = setup = replace(setup, tool=lifted_onto_table(setup.tool, setup.table))
        self.options = options or ArmOptions()
        self.limits = limits
        self.phases = motion.phases or plan.tool_motion.phases
        self.duration = float(times[-1] - times[0])
        if not self.duration <= 600:
            raise MagicError(Code.BAD_SCENE, "length of the motion", f"{self.duration:.0f} s", "up to 600 s")
        self.grasp_time = float(motion.grasp_time)
        self.release_time = None if motion.release_time is None else float(motion.release_time)
        start = phase_start(self.phases, CONTACT_PHASES)
        self.contact_time = self.duration if start is None else start
        self._motion = motion
        self.world = fill_world(setup, DYNAMIC)
        self._panda = Panda()
        self._robot = self._load()
        frequency = setup.settings.frequency
        clock = times[0] + np.arange(int(np.ceil(self.duration * frequency)) + 1) / frequency
        self._q = np.column_stack([np.interp(clock, times, positions[:, j]) for j in range(positions.shape[1])])
        self._qd = np.gradient(self._q, 1.0 / frequency, axis=0) if len(self._q) > 1 else np.zeros_like(self._q)
        self._index = 0
        self._hold = 0.0
        self._quiet = 0.0
        self._closing = self._closed = self._open_again = False
        self._reference: NDArray[np.float64] | None = None
        self._torque = np.zeros(len(ARM_JOINTS))
        self._metrics = {"tracking_error": 0.0, "torque_ratio": 0.0, "grasp_slip": 0.0, "grasp_turn": 0.0, "grip_width": float("nan")}
        open_half = self.options.opening / 2
        self._robot.set_qpos(np.array([*self._q[0], open_half, open_half]))
        self._finger_target = open_half

    # ------------------------------------------------------------ the robot

    def _load(self) -> Any:
        from sapien.wrapper.urdf_loader import URDFLoader

        tree = ET.fromstring(self._panda.urdf.read_text())
        for link in tree.findall("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
        for joint in tree.findall("joint"):
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)  # the coupling of the fingers is in their drives, see _drive_fingers
        text = ET.tostring(tree, encoding="unicode").replace("package://", f"{self._panda.root}/")
        loader = URDFLoader()
        loader.set_scene(self.world.scene)
        loader.fix_root_link = True
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(text)
            # The loader heeds only pairs with the reason "Default"; hand and link 7 are adjacent over a link without a body.
            pairs = (self._panda.urdf.parents[1] / "srdf/panda.srdf").read_text().replace('reason="Adjacent"', 'reason="Default"')
            (Path(folder) / "arm.srdf").write_text(pairs)
            robot = loader.load(str(path), srdf_file=str(Path(folder) / "arm.srdf"))
        robot.set_solver_position_iterations(self.setup.settings.position_iterations)
        robot.set_solver_velocity_iterations(self.setup.settings.velocity_iterations)
        options = self.options
        pads = self.world.material(options.finger_friction)
        for link in robot.links:
            finger = link.name in FINGER_LINKS
            self.world.name_component(link, FINGERS if finger else BASE if link is robot.root else ARM)
            for shape in link.collision_shapes if finger else ():
                shape.physical_material = pads
        self._arm_joints = [robot.find_joint_by_name(name) for name in ARM_JOINTS]
        self._finger_joints = [robot.find_joint_by_name(name) for name in FINGER_JOINTS]
        self._effort = np.array([self._panda.joints[name].effort for name in ARM_JOINTS])
        for joint, effort, stiffness, damping in zip(self._arm_joints, self._effort, options.stiffness, options.damping, strict=True):
            joint.set_drive_properties(stiffness, damping, force_limit=float(effort), mode="force")
            joint.set_armature(np.array([options.armature], dtype=np.float32))
        # Rows of the links that the arm's joints move, in the order in which the engine reports joint forces.
        self._driven = [[link.name for link in robot.links].index(self._panda.joints[name].child) for name in ARM_JOINTS]
        for joint in self._finger_joints:
            joint.set_drive_properties(
                options.finger_stiffness, options.grip_force / options.closing_speed, force_limit=200.0, mode="force"
            )
            joint.set_armature(np.array([0.1], dtype=np.float32))
        self._tcp = robot.find_link_by_name(TCP_LINK)
        self._order = [robot.active_joints.index(j) for j in (*self._arm_joints, *self._finger_joints)]
        if self._order != list(range(9)):
            raise MagicError(
                Code.BAD_SCENE, "order of the arm's joints", [j.name for j in robot.active_joints], [*ARM_JOINTS, *FINGER_JOINTS]
            )
        return robot

    # ------------------------------------------------------------ what the goal tests ask

    @property
    def time(self) -> float:
        """Seconds on the clock of the planned trajectory."""
        return self._index / self.setup.settings.frequency

    @property
    def phase(self) -> str:
        """The name of the present phase."""
        return phase_at(self.phases, self.time)

    @property
    def released(self) -> bool:
        """Whether the gripper has opened again."""
        return self._open_again

    def joints(self) -> NDArray[np.float64]:
        """(9,): seven joints of the arm in rad, two fingers in m."""
        return np.asarray(self._robot.qpos, dtype=float).ravel()

    def metrics(self) -> dict[str, float]:
        """Largest tracking error (rad), share of the effort limit used, slip (m, rad) and the width gripped (m)."""
        return {name: value for name, value in self._metrics.items() if np.isfinite(value)}

    # ------------------------------------------------------------ stepping

    def advance(self) -> None:
        """One step."""
        row = min(self._index, len(self._q) - 1)
        waiting = self._gripper()
        still = waiting or self._index >= len(self._q)
        command, speed = self._q[row], np.zeros(7) if still else self._qd[row]
        for joint, position, velocity in zip(self._arm_joints, command.tolist(), speed.tolist(), strict=True):
            joint.set_drive_target(position)
            joint.set_drive_velocity_target(velocity)
        self._drive_fingers()
        passive = self._robot.compute_passive_force(gravity=True, coriolis_and_centrifugal=True)
        self._robot.set_qf(passive)
        self.world.step()
        if not waiting:
            self._index += 1
        if self.world.steps % WATCH_EVERY == 0:
            self._watch(command)

    def _gripper(self) -> bool:
        """Open and close on time; whether the arm has to wait for the fingers."""
        if self.release_time is not None and self.time >= self.release_time and not self._open_again:
            self._open_again, self._closing = True, False
            self._finger_target = self.options.opening / 2
        if self._closed or self._open_again or self.time < self.grasp_time:
            return False
        self._closing = True
        dt = self.world.timestep
        self._hold += dt
        speed = float(np.abs(np.asarray(self._robot.qvel).ravel()[7:]).max())
        self._quiet = self._quiet + dt if speed < 0.002 and self._hold > 0.05 else 0.0
        if self._quiet >= self.options.quiet or self._hold >= self.options.closing_time:
            self._closed = True
            self._note_grasp()
            return False
        return True

    def _drive_fingers(self) -> None:
        if self._closing:
            # Both fingers are drawn to their mean less the way that gives the grip force: what moves them
            # together is resisted by that force alone, what moves one against the other by the stiffness.
            q = np.asarray(self._robot.qpos).ravel()[7:]
            self._finger_target = 0.5 * float(q[0] + q[1]) - self.options.grip_force / self.options.finger_stiffness
        for joint in self._finger_joints:
            joint.set_drive_target(self._finger_target)

    def _note_grasp(self) -> None:
        width = float(np.asarray(self._robot.qpos).ravel()[7:].sum())
        self._metrics["grip_width"] = width
        self._reference = self._tool_from_tcp()
        planned = np.asarray(self._motion.tool_from_tcp, dtype=float)
        self._metrics["grasp_shift"] = float(np.linalg.norm((transforms.inverse(planned) @ self._reference)[:3, 3]))
        if not self.world.touching(TOOL, FINGERS, 0.001):
            raise MagicError(
                Code.GRASP_SLIPPED,
                f"the gripper closed on nothing at {self.time:.2f} s",
                f"width {width * 1000:.1f} mm",
                f"both fingers on the tool, {self._motion.grasp_width * 1000:.1f} mm apart",
            )

    def _tool_from_tcp(self) -> NDArray[np.float64]:
        return transforms.inverse(self.world.pose(TOOL)) @ from_pose(self._tcp.entity_pose)

    def _watch(self, command: NDArray[np.float64]) -> None:
        q = np.asarray(self._robot.qpos, dtype=float).ravel()[:7]
        qd = np.asarray(self._robot.qvel, dtype=float).ravel()[:7]
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(qd))):
            raise MagicError(
                Code.SIMULATION_EXPLODED, f"state of the arm at {self.time:.2f} s", "not a number", "finite joint positions and velocities"
            )
        error = np.abs(q - command)
        worst = int(error.argmax())
        self._metrics["tracking_error"] = max(self._metrics["tracking_error"], float(error[worst]))
        if error[worst] > self.limits.tracking:
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"{ARM_JOINTS[worst]} lags behind its command at {self.time:.2f} s ({self.phase})",
                f"{error[worst]:.3f} rad",
                f"up to {self.limits.tracking:g} rad",
            )
        # What each joint transmits about its axis (x of SAPIEN's joint frames), averaged over about 0.1 s: a real arm
        # stops when the limit is exceeded for longer.
        share = WATCH_EVERY * self.world.timestep / 0.1
        transmitted = np.asarray(self._robot.get_link_incoming_joint_forces(), dtype=float)[self._driven, 3]
        self._torque += min(share, 1.0) * (transmitted - self._torque)
        ratio = np.abs(self._torque) / self._effort
        worst = int(ratio.argmax())
        self._metrics["torque_ratio"] = max(self._metrics["torque_ratio"], float(ratio[worst]))
        if ratio[worst] > 1:
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"torque of {ARM_JOINTS[worst]} at {self.time:.2f} s ({self.phase})",
                f"{abs(self._torque[worst]):.1f} Nm",
                f"up to {self._effort[worst]:g} Nm",
            )
        self._watch_contacts()
        self._watch_grasp()

    def _watch_contacts(self) -> None:
        early = self.time < self.contact_time
        for other in (TARGET, *(o.id for o in self.setup.obstacles), TABLE):
            parts = (ARM,) if other == TABLE else (ARM, FINGERS)
            for part in parts:
                if self.world.touching(part, other, -self.limits.overlap):
                    raise MagicError(
                        Code.PRE_CONTACT_COLLISION if early else Code.LIMIT_EXCEEDED,
                        f"the {'hand' if part == FINGERS else part} hit the {other} at {self.time:.2f} s ({self.phase})",
                    )

    def _watch_grasp(self) -> None:
        if self._reference is None or self._open_again:
            return
        drift = transforms.inverse(self._reference) @ self._tool_from_tcp()
        slip = float(np.linalg.norm(drift[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(drift[:3, :3]) - 1) / 2, -1, 1)))
        self._metrics["grasp_slip"] = max(self._metrics["grasp_slip"], slip)
        self._metrics["grasp_turn"] = max(self._metrics["grasp_turn"], turn)
        if slip > self.limits.slip or turn > self.limits.slip_angle:
            raise MagicError(
                Code.GRASP_SLIPPED,
                f"the tool slipped in the gripper at {self.time:.2f} s ({self.phase})",
                f"{slip * 1000:.1f} mm and {turn:.2f} rad",
                f"up to {self.limits.slip * 1000:.1f} mm and {self.limits.slip_angle:.2f} rad",
            )
