"""The arm run: an arm takes the tool and follows the planned joint trajectory (paper, Table I: Arm).

The arm is an articulation with PD joint drives, gravity and Coriolis torques fed
forward, and the effort limits of its URDF, as a position-controlled arm has.  Which
arm and which gripper: :class:`magic_core.robot.Description`, the Panda where none is
given.  The tool is a free body from the start; the fingers close on it, and what
they have closed on is held by no more than their friction (:mod:`magic_verifier.grip`),
by a joint that stands for soft pads or, where the options say so, by the engine's contacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import ArmMotion, MotionPlan
from magic_core.robot import Description
from magic_verifier.articulation import ARM, FINGERS, ArmOptions, Articulation, panda
from magic_verifier.floating import (
    CONTACT_PHASES,
    PUSHED_OUT,
    TABLE,
    TARGET,
    TOOL,
    Setup,
    fill_world,
    lifted_onto_table,
    phase_at,
    phase_start,
)
from magic_verifier.grip import SOFTNESS, Grip, Patch, patch_of
from magic_verifier.simulation import DYNAMIC, KINEMATIC

#: Tracking, torque, contacts and grasp are looked at every so many seconds.
WATCH_EVERY = 0.025
#: Where a run begins with the tool in the hand the fingers are farther apart by this (m), for a tool thicker than thought.
WIDER = 0.004
#: The fingers have come to a stop when they are no nearer than so many metres to where they were so many seconds before; a stiff
#: contact makes them tremble meanwhile.
STOPPED, LOOK_BACK = 0.0003, 0.05
#: Fingers that have stopped without holding anything press harder by so many newtons a second, up to the grip's force: what one of them
#: has met first slides along the table until the other meets it as well, however it sticks to it.
HARDER = 100.0
#: A target that weighs more than so many times the tool is pushed by more solver iterations, in proportion, up to so many times as many:
#: with too few a light tool lags behind the hand by what it moves in a step, which is read as a load on the pads, and creeps out of them.
HEAVIER, MOST_ITERATIONS = 10.0, 4.0
#: While the fingers close on a tool that weighs less than this (kg) steps are solved by more iterations, in proportion, up to so many times
#: as many: with 8 the fingers sank through a spoon of 18 g from both sides, with 16 through one of 9 g, and squeezed light hooks out.
LIGHTER, MOST_CLOSING = 0.07, 16.0
#: A tool that lies on the table is left unsolved once it has been slower than this (m/s) for 0.4 s, until the fingers begin to close or
#: something touches it: half of a step are contacts with the table that do nothing.
LYING = 0.001
#: An arm that has let go and come to the end of its motion is left to stand still, unsolved, after so many seconds.
ASLEEP = 0.15
#: So is one that holds its tool at the end, and the tool with it, where the pads bear no more than this share of what they hold and it has
#: moved by no more than so many metres since it was looked at last: what is then done to the target (0.1 m/s to a ball of 0.1 kg, 0.3 m
#: from the pads, are a fifth of what these hold) moves neither.
BORNE, STILL = 0.5, 0.0001


@dataclass(frozen=True)
class Held:
    """A tool in the hand: the moment of the trajectory in s, tool_from_tcp (4, 4) now and as the pads took it, metres between the
    fingers, where the pads touch it."""

    time: float
    tool_from_tcp: NDArray[np.float64]
    taken: NDArray[np.float64]
    width: float
    patch: Patch


@dataclass
class _Closing:
    """How the fingers close: ``press``, the force of each (N); seconds since they began, and for which they have stood still; metres
    between them, step by step; the solver iterations of the tool before."""

    press: float
    seconds: float = 0.0
    quiet: float = 0.0
    widths: list[float] = field(default_factory=list)
    iterations: int = 0


def _sampled(motion: ArmMotion, frequency: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint positions and velocities (N, J) of a trajectory, step by step."""
    times, positions = np.asarray(motion.times, dtype=float), np.asarray(motion.positions, dtype=float)
    clock = times[0] + np.arange(int(np.ceil((times[-1] - times[0]) * frequency)) + 1) / frequency
    q = np.column_stack([np.interp(clock, times, positions[:, j]) for j in range(positions.shape[1])])
    return q, np.gradient(q, 1.0 / frequency, axis=0) if len(q) > 1 else np.zeros_like(q)


class ArmRun:
    """One run of an arm plan; :meth:`advance` steps it once.

    ``time`` is the clock of the planned trajectory, which stands still while the
    gripper closes; ``world.time`` goes on.  With ``held`` the run begins at that moment
    of the trajectory, arm and tool as fast as they are then, the tool in the hand.
    Where the gripper of a plan closes at its very start the tool is in the hand already:
    the fingers are about it, and it does not fall before they have closed.  It is then held where
    the plan has it: real pads have turned it as they do, which those about its reconstruction would do once more.
    ``lag``: seconds by which the arm follows its command late; ``begin``: the moment of the trajectory at which a run
    with an empty hand begins.  ``rests``: the tool was seen to lie where it is, and does so until something touches it, whatever its shape
    and its masses are taken to be.  ``offset``: the contact offset (m) of tool and target as soon as the tool is held; closing fingers need
    the world's.  :attr:`stands_still`: the tool may be taken to stay where it is when the motion is over and it is held still.
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
        begin: float = 0.0,
        rests: bool = False,
        offset: float | None = None,
    ) -> None:
        self.robot = robot = robot or panda()
        motion = plan.arm_motion
        if motion is None:
            raise MagicError(Code.BAD_MOTION, "plan", "without an arm motion", "an arm motion")
        self._in_hand = held is None and motion.grasp_time <= 0
        if held is None and not self._in_hand:
            setup = replace(setup, tool=lifted_onto_table(setup.tool, setup.table))
        self.setup = setup
        self.options = options or ArmOptions()
        self._coupled = self.options.past is None  # hand and tool, by a joint
        self.limits = limits
        self.phases = motion.phases or plan.tool_motion.phases
        self.duration = float(motion.times[-1]) - float(motion.times[0])
        self.grasp_time = float(motion.grasp_time)
        self.release_time = None if motion.release_time is None else float(motion.release_time)
        start = phase_start(self.phases, CONTACT_PHASES)
        self.contact_time = self.duration if start is None else start
        self._motion = motion
        self._rests = rests and held is None and not self._in_hand
        self._offset = setup.settings.contact_offset if offset is None else offset
        self.world = fill_world(setup, KINEMATIC if self._rests else DYNAMIC)
        if self._coupled and held is None and not self._in_hand:
            self.world.doze(TOOL, LYING)
        if setup.target_kind == DYNAMIC:
            self._iterate_for_weight()
        self._arm = Articulation(self.world, robot, self.options)
        self._obstacles = frozenset((TARGET, *(o.id for o in setup.obstacles)))
        self._loose = frozenset(o.id for o in setup.obstacles if o.loose)
        frequency = setup.settings.frequency
        self._lag = round(lag * frequency)
        self._q, self._qd = _sampled(motion, frequency)
        self._index = self._first = 0
        self._closing = _Closing(self.options.closing_force)
        self._closed = self._open_again = self._asleep = self.stands_still = False
        self._after = round(ASLEEP * frequency)
        self._every = max(1, round(WATCH_EVERY * frequency))
        self._grip: Grip | None = None
        self._patch: Patch | None = None
        self._friction = (self.options.finger_friction + setup.physics.friction) / 2  # of a pair, as the engine has it
        self._from_reference: Any = None  # tcp from tool, when the grip was made
        self._let_go_at: NDArray[np.float64] | None = None
        self._load, self._was = 0.0, np.full(3, np.inf)  # of the grip, and where the tool was, when they were looked at last
        sliding, turning = ("tracking_error_slide", limits.tracking_slide, "m"), ("tracking_error", limits.tracking, "rad")
        self._tracking = [sliding if joint.sliding else turning for joint in robot.arm]
        self._torque = [0.0] * len(robot.names)
        self._effort = self._arm.effort.tolist()
        self._metrics = {"torque_ratio": 0.0, "grip_load": 0.0, "grasp_slip": 0.0, "grasp_turn": 0.0, "grip_width": float("nan")}
        self._begin(held, begin)
        self._positions, self._led = self._q[self._first :], self._commands()[self._first :]

    def _iterate_for_weight(self) -> None:
        """More solver iterations where the target is much heavier than the tool (:data:`HEAVIER`)."""
        tool, target = self.world.component(TOOL), self.world.component(TARGET)
        share = min(max(target.mass / tool.mass / HEAVIER, 1.0), MOST_ITERATIONS)
        self._iterate(round(share * self.setup.settings.position_iterations))

    def _iterate(self, count: int) -> None:
        """Solve what the tool takes part in by so many iterations."""
        self.world.component(TOOL).solver_position_iterations = count

    def _wake(self) -> None:
        """The tool that rested where it was seen is touched, and moves as it would from now on."""
        self._rests = False
        self.world.let_go(TOOL)

    def _commands(self) -> NDArray[np.float64]:
        """What the drives are told (N, J), step by step: ahead of the trajectory by what they lead by, and kept for the command's
        period."""
        led = self._q + self._arm.lead * self._qd
        if self.options.command_period > 0:
            # A command that stays is that of the middle of its time.
            period = self.options.command_period * self.setup.settings.frequency
            middle = ((np.floor(np.arange(len(led)) / period + 1e-9) + 0.5) * period).astype(int)
            led = led[np.minimum(middle, len(led) - 1)]
        return led

    def _begin(self, held: Held | None, begin: float) -> None:
        """Put arm, fingers and a tool in the hand where the run begins: with the tool as it was ``held``, or as the plan has it in the
        hand, or with an empty hand at the moment ``begin``."""
        if self._in_hand:
            self._arm.place(self._q[0], min(self._motion.grasp_width + WIDER, self.robot.config.opening))
            self.world.component(TOOL).disable_gravity = True
            return
        time = begin if held is None else held.time
        self._index = self._first = min(round(time * self.setup.settings.frequency), len(self._q) - 1)
        if held is None:
            self._arm.place(self._q[self._index])
            self._arm.open_fingers()
        else:
            self._arm.place(self._q[self._index], held.width + WIDER)
            self.world.place(TOOL, self._arm.tcp() @ transforms.inverse(held.tool_from_tcp))
            self._closed = True
            self._take(held.patch)
            self._set_off()

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
        if self._patch is None or self._open_again:
            return None
        taken = transforms.inverse(self._from_reference.to_transformation_matrix())
        return Held(self.time, self._tool_from_tcp(), taken, self._arm.width(), self._patch)

    def joints(self) -> NDArray[np.float64]:
        """(J + 2,): the arm's joints in rad (m), then the fingers in m."""
        return self._arm.joints()

    def metrics(self) -> dict[str, float]:
        """Largest tracking error (rad; m of sliding joints), share of the effort limit used, slip (m, rad) and the width gripped (m)."""
        return {name: value for name, value in self._metrics.items() if np.isfinite(value)}

    # ------------------------------------------------------------ stepping

    def advance(self) -> None:
        """One step."""
        if self._asleep:
            self.world.step()
            self._index += 1
            return
        row = min(max(self._index - self._lag - self._first, 0), len(self._positions) - 1)
        waiting = self._gripper()
        still = waiting or self._index >= len(self._q)
        self._arm.drive((self._positions if still else self._led)[row].tolist())
        self.world.step()
        if self._rests and self.world.touched_by(TOOL):
            self._wake()
        if not waiting:
            self._index += 1
        over = self._index - (len(self._q) + self._lag + self._after)
        if self._let_go_at is not None and over == 0:
            self._asleep = self._arm.sleeps()
        if self.world.steps % self._every == 0:
            self._watch(self._positions[row].tolist())
            if self.stands_still and over >= 0 and self._held_still() and self._arm.sleeps():
                self.world.hold(TOOL)
                self._asleep = True

    def _held_still(self) -> bool:
        """Whether the pads hold the tool with ease, where it was when this was asked last."""
        before, self._was = self._was, self.world.position(TOOL)
        if self._grip is None or self._open_again or self._load > BORNE:
            return False
        return bool(math.dist(before, self._was) <= STILL)

    def _gripper(self) -> bool:
        """Open and close on time; whether the arm has to wait for the fingers."""
        if self.release_time is not None and self.time >= self.release_time and not self._open_again:
            self._open_again = True
            self._let_go_at = self._arm.tcp()[:3, 3].copy()
            if self._grip is not None:
                self._grip.open()
                self._arm.lets_go(self.world.component(TOOL))
                self.world.component(TOOL).max_depenetration_velocity = PUSHED_OUT
            self._arm.open_fingers()
        if self._closed or self._open_again or self.time < self.grasp_time:
            return False
        self._close()
        return self._coupled and not self._closed

    def _close(self) -> None:
        """One step of the closing fingers, until they hold the tool.  Raises ``GRASP_SLIPPED`` where they come to a stop on nothing."""
        closing, dt = self._closing, self.world.timestep
        if closing.seconds == 0 and self._coupled:
            tool = self.world.component(TOOL)
            self.world.doze(TOOL, 0.0)
            closing.iterations = tool.solver_position_iterations
            self._iterate(round(min(max(LIGHTER / tool.mass, 1.0), MOST_CLOSING) * closing.iterations))
        closing.seconds += dt
        closing.widths.append(self._arm.width())
        before = closing.widths[max(0, len(closing.widths) - 1 - round(LOOK_BACK / dt))]
        slow = closing.seconds > LOOK_BACK and abs(closing.widths[-1] - before) < STOPPED
        closing.quiet = closing.quiet + dt if slow else 0.0
        if slow:
            patch = self._touched()
            if patch is not None:
                self._take(patch)
                if self._coupled:
                    self._arm.rest_fingers()
            elif self._coupled and closing.press < self.options.grip_force:
                closing.press = min(closing.press + HARDER * dt, self.options.grip_force)
                closing.quiet = 0.0
        if self._patch is None and closing.quiet < self.options.quiet and closing.seconds < self.options.closing_time:
            self._arm.close_fingers(closing.press)
            return
        self._closed = True
        if self._coupled:
            self._iterate(closing.iterations)
        if self._patch is None:
            raise MagicError(
                Code.GRASP_SLIPPED,
                f"the gripper closed on nothing at {self.time:.2f} s",
                f"width {self._arm.width() * 1000:.1f} mm",
                f"both fingers on the tool, {self._motion.grasp_width * 1000:.1f} mm apart",
            )

    def _touched(self) -> Patch | None:
        """Where both pads touch the tool; ``None`` where they do not hold it between them."""
        tcp, closing = self._arm.tcp(), "xy".index(self.robot.config.closing_axis)
        return patch_of(self.world.pressed(TOOL, FINGERS, SOFTNESS, tcp[:3, closing]), tcp, closing, self._friction)

    def _take(self, patch: Patch) -> None:
        """The tool is held, as it is between the pads, or as it was before they closed on what was in them already."""
        self._patch = patch
        if self._rests:
            self._wake()
        planned = np.asarray(self._motion.tool_from_tcp, dtype=float)
        if self._in_hand:
            self.world.place(TOOL, self._arm.tcp() @ transforms.inverse(planned))
        self.world.component(TOOL).disable_gravity = False
        if self._offset != self.setup.settings.contact_offset:
            self.world.set_offset((TOOL, TARGET), self._offset)
        if self._coupled:
            self._grip = self._arm.grips(self.world.component(TOOL), patch, self._friction)
        self._from_reference = self._arm.tcp_pose.inv() * self.world.component(TOOL).entity_pose
        self._metrics["grip_width"] = self._arm.width()
        self._metrics["grasp_shift"] = float(np.linalg.norm((transforms.inverse(planned) @ self._tool_from_tcp())[:3, 3]))

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

    def _tool_from_tcp(self) -> NDArray[np.float64]:
        return transforms.inverse(self.world.pose(TOOL)) @ self._arm.tcp()

    def _watch(self, command: list[float]) -> None:
        self._watch_tracking(self._arm.lags(command))
        self._watch_torque()
        self._watch_contacts()
        self._watch_grasp()

    def _watch_tracking(self, lags: list[float]) -> None:
        metrics = self._metrics
        for joint, (lag, (name, allowed, unit)) in enumerate(zip(lags, self._tracking, strict=True)):
            if lag > metrics.get(name, 0.0):
                metrics[name] = lag
            if lag > allowed:
                raise MagicError(
                    Code.LIMIT_EXCEEDED,
                    f"{self.robot.names[joint]} lags behind its command at {self.time:.2f} s ({self.phase})",
                    f"{lag:.3f} {unit}",
                    f"up to {allowed:g} {unit}",
                )
            if not lag <= allowed:
                raise MagicError(
                    Code.SIMULATION_EXPLODED,
                    f"state of the arm at {self.time:.2f} s",
                    "not a number",
                    "finite joint positions and velocities",
                )

    def _watch_torque(self) -> None:
        # Averaged over about 0.1 s: a real arm stops when the limit is exceeded for longer.
        share = min(self._every * self.world.timestep / 0.1, 1.0)
        torque = self._torque = [before + share * (now - before) for before, now in zip(self._torque, self._arm.transmitted(), strict=True)]
        ratio = [abs(carried) / effort for carried, effort in zip(torque, self._effort, strict=True)]
        most = max(ratio)
        self._metrics["torque_ratio"] = max(self._metrics["torque_ratio"], most)
        if most > 1:
            worst = ratio.index(most)
            what, unit = ("force", "N") if self.robot.arm[worst].sliding else ("torque", "Nm")
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"{what} of {self.robot.names[worst]} at {self.time:.2f} s ({self.phase})",
                f"{abs(torque[worst]):.1f} {unit}",
                f"up to {self._effort[worst]:g} {unit}",
            )

    def _watch_contacts(self) -> None:
        world, limits = self.world, self.limits
        for part in (ARM, FINGERS):
            for other in world.touched_by(part):
                if other != TABLE and other not in self._obstacles:
                    continue
                # The solver lets a link go next to no way into what stands fast, however hard it presses; what is loose gives way.
                force = 0.0 if other in self._loose else world.force(part, other)
                if force <= limits.early_force and world.depth(part, other) <= limits.overlap:
                    continue
                raise MagicError(
                    Code.PRE_CONTACT_COLLISION if self.time < self.contact_time else Code.LIMIT_EXCEEDED,
                    f"the {'hand' if part == FINGERS else part} hit the {other} at {self.time:.2f} s ({self.phase})",
                    f"{force:.1f} N",
                    f"up to {limits.early_force:g} N",
                )

    def _watch_grasp(self) -> None:
        if self._patch is None or self._open_again:
            return
        if self._grip is not None:
            self._load = self._grip.load()
            self._metrics["grip_load"] = max(self._metrics["grip_load"], self._load)
        drift = self._from_reference * self.world.component(TOOL).entity_pose.inv() * self._arm.tcp_pose
        slip = math.hypot(*drift.p.tolist())
        turn = 2 * math.acos(min(abs(float(drift.q[0])), 1.0))
        self._metrics["grasp_slip"] = max(self._metrics["grasp_slip"], slip)
        self._metrics["grasp_turn"] = max(self._metrics["grasp_turn"], turn)
        if slip > self.limits.slip or turn > self.limits.slip_angle:
            raise MagicError(
                Code.GRASP_SLIPPED,
                f"the tool slipped in the gripper at {self.time:.2f} s ({self.phase})",
                f"{slip * 1000:.1f} mm and {turn:.2f} rad",
                f"up to {self.limits.slip * 1000:.1f} mm and {self.limits.slip_angle:.2f} rad",
            )
