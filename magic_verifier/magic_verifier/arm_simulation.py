"""The arm run: an arm takes the tool and follows the planned joint trajectory (paper, Table I: Arm).

The arm is an articulation with PD joint drives, gravity and Coriolis torques fed
forward, and the effort limits of its URDF, as a position-controlled arm has.  Which
arm and which gripper: :class:`magic_core.robot.Description`, the Panda where none is
given.  The tool is a free body from the start and is held by nothing but the friction
of the fingers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.robot import Description
from magic_verifier.articulation import ARM, FINGERS, ArmOptions, Articulation, panda
from magic_verifier.floating import CONTACT_PHASES, TABLE, TARGET, TOOL, Setup, fill_world, lifted_onto_table, phase_at, phase_start
from magic_verifier.simulation import DYNAMIC, KINEMATIC

#: Tracking, torque, contacts and grasp are looked at every so many steps.
WATCH_EVERY = 6
#: Where a run begins with the tool in the hand the fingers begin farther apart by this (m), for a tool thicker than thought.
WIDER = 0.008


@dataclass(frozen=True)
class Held:
    """A tool in the hand: the moment of the trajectory in s, tool_from_tcp (4, 4), metres between the fingers."""

    time: float
    tool_from_tcp: NDArray[np.float64]
    width: float


class ArmRun:
    """One run of an arm plan; :meth:`advance` steps it once.

    ``time`` is the clock of the planned trajectory, which stands still while the
    gripper closes; ``world.time`` goes on.  With ``held`` the run begins at that moment
    of the trajectory with the tool in the hand, where the fingers close on it anew.
    ``lag``: seconds by which the arm follows its command late.
    """

    variant = "arm"

    def __init__(
        self,
        setup: Setup,
        plan: MotionPlan,
        options: ArmOptions | None,
        limits: Any,
        robot: Description | None = None,
        held: Held | None = None,
        lag: float = 0.0,
    ) -> None:
        self.robot = robot = robot or panda()
        motion = plan.arm_motion
        if motion is None:
            raise MagicError(Code.BAD_MOTION, "plan", "without an arm motion", "an arm motion")
        positions = np.asarray(motion.positions, dtype=float)
        times = np.asarray(motion.times, dtype=float)
        if held is None:
            setup = replace(setup, tool=lifted_onto_table(setup.tool, setup.table))
        self.setup = setup
        self.options = options or ArmOptions()
        self.limits = limits
        self.phases = motion.phases or plan.tool_motion.phases
        self.duration = float(times[-1] - times[0])
        self.grasp_time = float(motion.grasp_time)
        self.release_time = None if motion.release_time is None else float(motion.release_time)
        start = phase_start(self.phases, CONTACT_PHASES)
        self.contact_time = self.duration if start is None else start
        self._motion = motion
        self.world = fill_world(setup, DYNAMIC if held is None else KINEMATIC)
        self._arm = Articulation(self.world, robot, self.options)
        self._slides = np.array([joint.sliding for joint in robot.arm])
        self._held = held
        self._lag = round(lag * setup.settings.frequency)
        frequency = setup.settings.frequency
        clock = times[0] + np.arange(int(np.ceil(self.duration * frequency)) + 1) / frequency
        self._q = np.column_stack([np.interp(clock, times, positions[:, j]) for j in range(positions.shape[1])])
        self._qd = np.gradient(self._q, 1.0 / frequency, axis=0) if len(self._q) > 1 else np.zeros_like(self._q)
        self._index = self._first = 0
        self._hold = 0.0
        self._quiet = 0.0
        self._closing = self._closed = self._open_again = False
        self._reference: NDArray[np.float64] | None = None
        self._let_go_at: NDArray[np.float64] | None = None
        self._torque = np.zeros(len(robot.names))
        self._metrics = {"torque_ratio": 0.0, "grasp_slip": 0.0, "grasp_turn": 0.0, "grip_width": float("nan")}
        if held is None:
            self._arm.place(self._q[0])
        else:
            self._index = self._first = min(round(held.time * frequency), len(self._q) - 1)
            self._arm.place(self._q[self._index], held.width + WIDER)
            self.world.place(TOOL, self._arm.tcp() @ transforms.inverse(held.tool_from_tcp))

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

    def hand_has_left(self) -> float:
        """By how many metres the hand has gone away from where it let the tool go."""
        return 0.0 if self._let_go_at is None else float(np.linalg.norm(self._arm.tcp()[:3, 3] - self._let_go_at))

    def held(self) -> Held | None:
        """The tool in the hand at this moment, to begin another run from; ``None`` where it is not."""
        if self._reference is None or self._open_again:
            return None
        return Held(self.time, self._tool_from_tcp(), self._arm.width())

    def joints(self) -> NDArray[np.float64]:
        """(J + 2,): the arm's joints in rad (m), then the fingers in m."""
        return self._arm.joints()

    def metrics(self) -> dict[str, float]:
        """Largest tracking error (rad; m of sliding joints), share of the effort limit used, slip (m, rad) and the width gripped (m)."""
        return {name: value for name, value in self._metrics.items() if np.isfinite(value)}

    # ------------------------------------------------------------ stepping

    def advance(self) -> None:
        """One step."""
        row = min(max(self._index - self._lag, self._first), len(self._q) - 1)
        waiting = self._gripper()
        still = waiting or self._index >= len(self._q)
        command = self._q[row]
        (self._arm.close_fingers if self._closing else self._arm.open_fingers)()
        self._arm.command(command, np.zeros_like(command) if still else self._qd[row])
        self.world.step()
        if not waiting:
            self._index += 1
        if self.world.steps % WATCH_EVERY == 0:
            self._watch(command)

    def _gripper(self) -> bool:
        """Open and close on time; whether the arm has to wait for the fingers."""
        if self.release_time is not None and self.time >= self.release_time and not self._open_again:
            self._open_again, self._closing = True, False
            self._let_go_at = self._arm.tcp()[:3, 3].copy()
        if self._closed or self._open_again or self.time < self.grasp_time:
            return False
        self._closing = True
        dt = self.world.timestep
        self._hold += dt
        self._quiet = self._quiet + dt if self._arm.finger_speed() < 0.002 and self._hold > 0.05 else 0.0
        if self._quiet >= self.options.quiet or self._hold >= self.options.closing_time:
            self._closed = True
            if self._held is not None:
                self.world.let_go(TOOL)
                self._set_off()
            self._note_grasp()
            return False
        return True

    def _set_off(self) -> None:
        """Arm and tool as fast as they are at this moment of the trajectory, which the run begins in the middle of."""
        row, dt = self._index, self.world.timestep
        speed = self._qd[row]
        self._arm.set_speed(speed)
        now, soon = self.robot.forward(np.stack([self._q[row], self._q[row] + dt * speed]))
        step = soon @ transforms.inverse(now)
        middle = self.world.centre_of_mass(TOOL)
        self.world.set_velocity(TOOL, (transforms.apply(step, middle) - middle) / dt)
        self.world.set_turning(TOOL, Rotation.from_matrix(step[:3, :3]).as_rotvec() / dt)

    def _note_grasp(self) -> None:
        width = self._arm.width()
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
        return transforms.inverse(self.world.pose(TOOL)) @ self._arm.tcp()

    def _watch(self, command: NDArray[np.float64]) -> None:
        q, qd = self._arm.arm_state()
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(qd))):
            raise MagicError(
                Code.SIMULATION_EXPLODED, f"state of the arm at {self.time:.2f} s", "not a number", "finite joint positions and velocities"
            )
        self._watch_tracking(q - command)
        self._watch_torque()
        self._watch_contacts()
        self._watch_grasp()

    def _watch_tracking(self, error: NDArray[np.float64]) -> None:
        lag, slides = np.abs(error), self._slides
        for name, lags in (("tracking_error", lag[~slides]), ("tracking_error_slide", lag[slides])):
            if len(lags):
                self._metrics[name] = max(self._metrics.get(name, 0.0), float(lags.max()))
        allowed = np.where(slides, self.limits.tracking_slide, self.limits.tracking)
        worst = int((lag / allowed).argmax())
        if lag[worst] > allowed[worst]:
            unit = "m" if slides[worst] else "rad"
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"{self.robot.names[worst]} lags behind its command at {self.time:.2f} s ({self.phase})",
                f"{lag[worst]:.3f} {unit}",
                f"up to {allowed[worst]:g} {unit}",
            )

    def _watch_torque(self) -> None:
        # Averaged over about 0.1 s: a real arm stops when the limit is exceeded for longer.
        share = WATCH_EVERY * self.world.timestep / 0.1
        self._torque += min(share, 1.0) * (self._arm.transmitted() - self._torque)
        ratio = np.abs(self._torque) / self._arm.effort
        worst = int(ratio.argmax())
        self._metrics["torque_ratio"] = max(self._metrics["torque_ratio"], float(ratio[worst]))
        if ratio[worst] > 1:
            what, unit = ("force", "N") if self.robot.arm[worst].sliding else ("torque", "Nm")
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"{what} of {self.robot.names[worst]} at {self.time:.2f} s ({self.phase})",
                f"{abs(self._torque[worst]):.1f} {unit}",
                f"up to {self._arm.effort[worst]:g} {unit}",
            )

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
