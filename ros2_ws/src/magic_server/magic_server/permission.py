"""What may move: the one rule that publishing a trajectory and carrying it out both ask.  No ROS here.

A :class:`Claim` asks: a motion with its verdict and with what it was planned for.  A :class:`World` is what there is at this very
moment.  :func:`permit` holds the two together and raises what speaks against it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_server import scene_change
from magic_server.joints import Joint, check_start

#: How far ahead of this clock a stamp may be, s: clocks of cameras and computers differ by less.
AHEAD = 0.5

#: What stands in a result that rests on something that nobody has seen.
ARM_UNKNOWN = "the arm's state is not known (no joint_states came): it is assumed to stand at its home configuration"
RECORDED = "what was seen comes from a recording"


class NotYet(MagicError):
    """What may pass by waiting: something is too old, or missing for a moment."""


class Purpose(Enum):
    """What is asked for: to publish a trajectory, to leave a published one standing, to have the arm move."""

    PUBLISH = "published"
    STAND = "left standing"
    MOVE = "carried out"


@dataclass(frozen=True)
class Verdict:
    """What the verifier answered; ``code`` OK means that the goal test passed often enough for the verifier.

    success_rate of ``rollouts`` simulations, with its 95 % interval from rate_low to rate_high; failures: why some failed.
    server: who answered (see :class:`Exchange`); run: for which run that was asked; motion: which motion, by its mark: of a run
    in which motions are planned anew each has its own verdict.
    """

    code: Code
    message: str = ""
    success_rate: float = 0.0
    rate_low: float = 0.0
    rate_high: float = 0.0
    rollouts: int = 0
    failures: tuple[str, ...] = ()
    server: bytes = b""
    run: str = ""
    motion: bytes = b""


@dataclass(frozen=True)
class Look:
    """The objects as seen at one moment: hulls (see :mod:`magic_server.scene_change`) by id, in ``frame``; ``stamp`` by the clock
    of the stamps and ``came`` by the monotonic clock of this process, both in seconds.  cut_off: what keeps a part of a thing out of
    sight, by its id (SceneObject.cut_off).  remembered: the same hulls of what nothing shows now, because the robot hides it."""

    objects: Mapping[str, NDArray[np.float64]]
    frame: str
    stamp: float
    came: float
    cut_off: Mapping[str, frozenset[str]] = field(default_factory=dict)
    remembered: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def partly(self, before: Look, moved: Collection[str] = ()) -> frozenset[str]:
        """Ids of what something hides a part of now that did not before; ``moved``: ids of what is elsewhere on purpose."""
        return frozenset(name for name, by in self.cut_off.items() if by - (before.cut_off.get(name, frozenset()) - set(moved)))


@dataclass(frozen=True)
class Claim:
    """A motion that is to be published or carried out.

    Attributes
    ----------
    run : the run that it belongs to.
    frames : of its trajectories.
    scene : what it was planned for.
    verdict, waived : ``None`` where physics cannot judge; ``waived`` then says that goal and server both accept that, for the arm alone.
    joints, start : of an arm's trajectory, and their positions, rad, where the next move begins; both empty without an arm.
    state_known : whether the plan began where the arm was heard to be; else it began at home.
    meant : ids of what the motion itself has moved so far.
    carried : hull of the tool where it was when the newest objects were seen, if the arm has, or had, it in its hand, else ``None``.
    said : what perception had to say of that scene, of what it does not show for one.
    motion, mark : the motion itself, which the rule does not look into, and what tells it from others, as its verdict has it.
    """

    run: str
    frames: frozenset[str]
    scene: Look
    verdict: Verdict | None
    waived: bool = False
    joints: tuple[str, ...] = ()
    start: tuple[float, ...] = ()
    state_known: bool = True
    meant: frozenset[str] = frozenset()
    carried: NDArray[np.float64] | None = field(default=None, compare=False)
    said: tuple[str, ...] = ()
    motion: Any = field(default=None, compare=False)
    mark: bytes = b""


@dataclass(frozen=True)
class World:
    """What there is now.

    Attributes
    ----------
    clock, now : the time, s, by the clock of the stamps and by the monotonic clock.
    run, canceled : the run at work, empty: none; whether it was canceled.
    servers : by what they do (``verifier`` is one), those who serve it.
    scene : the newest; ``None``: none came.
    joints : what was heard of them, by name.
    recorded : the server is told that all comes from a recording, which no time makes older.
    replaying : a bag is being played, whose stamps are of another time.
    active, stopped : the server's lifecycle is in the state active; an emergency stop has been asked for since it came there.
    simulated : the clock of the stamps is a simulation's, which may be slower than any other, so that it alone tells how old a thing is.
    """

    clock: float
    now: float
    run: str = ""
    canceled: bool = False
    servers: Mapping[str, frozenset[bytes]] = field(default_factory=dict)
    scene: Look | None = None
    joints: Mapping[str, Joint] = field(default_factory=dict)
    recorded: bool = False
    replaying: bool = False
    active: bool = False
    stopped: bool = False
    simulated: bool = False


@dataclass(frozen=True)
class Limits:
    """frame: the robot's base.  required_rate: of the lower end of the success rate's interval.  objects_age, state_age: s.
    object_tolerance: m that an object may have moved.  start_tolerance: rad that a joint may be off the start."""

    frame: str
    required_rate: float = 0.5
    objects_age: float = 5.0
    object_tolerance: float = 0.02
    state_age: float = 0.5
    start_tolerance: float = 0.02


def permit(claim: Claim, world: World, limits: Limits, purpose: Purpose) -> tuple[str, ...]:
    """What the permission rests on without having been seen, in sentences; raises :class:`MagicError` where there is none.

    CANCELED (an emergency stop too), SERVER_UNAVAILABLE (not active too), NOT_ALONE, NOT_VERIFIABLE, NOT_SURE_ENOUGH or
    the verdict's own code, BAD_REQUEST (frames, recordings), NO_OBJECTS, STALE_DATA, NO_FRAMES, BAD_MOTION; as
    :class:`NotYet` where it may pass by waiting.

    What was published stays valid only while nothing has changed that it was verified for: the objects, and where the arm
    stands.  That the run is over by then, or that servers have ended, does not speak against it.
    """
    _in_operation(world, purpose)
    if purpose is not Purpose.STAND:
        _at_work(claim, world)
        _alone(claim, world)
    _judged(claim, limits, purpose)
    if purpose is Purpose.MOVE and (world.recorded or world.replaying):
        raise MagicError(Code.BAD_REQUEST, f"no arm moves by a recording: {RECORDED}", allowed="objects that are seen now")
    _frames(claim, world, limits)
    seen = _seen(world, limits)
    # Once the arm is among the objects it hides some of what was seen of them from where the motion began, and so does what it carries.
    among = bool(claim.meant)
    # What was hidden then was planned with as it was remembered; now that it is seen it has not come.
    shown = {name: there for name, there in claim.scene.remembered.items() if name in seen.objects}
    scene_change.check(
        {**shown, **claim.scene.objects},
        seen.objects,
        limits.object_tolerance,
        claim.meant,
        seen.partly(claim.scene, claim.meant) if among else (),
        claim.carried,
        seen.remembered if among else (),
    )
    notes = _arm(claim, world, limits, purpose)
    return (*notes, *((RECORDED,) if world.recorded or world.replaying else ()), *claim.said)


def _in_operation(world: World, purpose: Purpose) -> None:
    """Nobody has asked for an emergency stop, and somebody has for the arm to be moved."""
    if world.stopped:
        raise MagicError(
            Code.CANCELED, "an emergency stop was asked for", allowed="nothing, until the strategy server's lifecycle is activated again"
        )
    if purpose is Purpose.MOVE and not world.active:
        raise MagicError(
            Code.SERVER_UNAVAILABLE, "the strategy server's lifecycle is not active", allowed="active: ros2 lifecycle set, or autostart"
        )


def _at_work(claim: Claim, world: World) -> None:
    """The run that asks is the one at work, and nobody has canceled it."""
    if world.canceled:
        raise MagicError(Code.CANCELED, "canceled")
    if world.run != claim.run:
        raise MagicError(Code.CANCELED, "the run that asks", claim.run, f"the one at work: {world.run or 'none'}")


def check_single(servers: Mapping[str, frozenset[bytes]]) -> None:
    """Refuse what several servers serve: nobody can say whose answer comes, and a motion would be carried out by each.

    Raises NOT_ALONE, which may pass: one that was killed stays in sight for a moment.
    """
    for name, there in servers.items():
        if len(there) > 1:
            raise NotYet(Code.NOT_ALONE, f"servers of {name}", len(there), 1)


def _alone(claim: Claim, world: World) -> None:
    """There is one server of each kind, and the verifier is still the one that judged."""
    check_single(world.servers)
    if claim.verdict is None:
        return
    verifiers = world.servers.get("verifier", frozenset())
    if not verifiers:
        raise NotYet(Code.SERVER_UNAVAILABLE, "the verifier that judged has gone")
    if claim.verdict.server not in verifiers:
        raise MagicError(Code.NOT_ALONE, "the verifier that is there is another one than the one that judged")


def _judged(claim: Claim, limits: Limits, purpose: Purpose) -> None:
    """Physics has agreed, for this run, and often enough."""
    verdict = claim.verdict
    if verdict is None:
        if not (claim.waived and purpose is Purpose.MOVE):
            raise MagicError(Code.NOT_VERIFIABLE, "simulation cannot judge this motion")
        return
    if verdict.code != Code.OK:
        raise MagicError(verdict.code, f"the verifier's verdict is no: {verdict.message}")
    if verdict.run != claim.run:
        raise MagicError(Code.INTERNAL, "the verdict's run", verdict.run, claim.run)
    if verdict.motion != claim.mark:
        raise MagicError(Code.INTERNAL, "the verdict is about another motion", verdict.motion.hex()[:8], claim.mark.hex()[:8])
    if not verdict.rate_low >= limits.required_rate:
        raise MagicError(
            Code.NOT_SURE_ENOUGH,
            "lower end of the success rate",
            f"{verdict.rate_low:.2f}, of {verdict.rollouts} rollouts {100 * verdict.success_rate:.0f} % succeeded",
            f"at least {limits.required_rate:g}; the parameter required_rate",
        )


def _frames(claim: Claim, world: World, limits: Limits) -> None:
    """Everything is told in the robot's base frame."""
    named = {*claim.frames, claim.scene.frame, *([world.scene.frame] if world.scene is not None else [])}
    for frame in sorted(named - {limits.frame}):
        raise MagicError(Code.BAD_REQUEST, "frame of objects or trajectory", frame, f"{limits.frame}, the robot's base frame")


def _seen(world: World, limits: Limits) -> Look:
    """The newest objects, which were seen just now, by their stamp and by their arrival."""
    if world.scene is None:
        raise NotYet(Code.NO_OBJECTS, "no objects have come")
    if world.recorded:
        return world.scene
    ages = {} if world.simulated else {"arrival": world.now - world.scene.came}
    if not world.replaying:
        ages["stamp"] = world.clock - world.scene.stamp
    for by, age in ages.items():
        if not -AHEAD <= age <= limits.objects_age:
            hint = "" if by == "arrival" else "; of a bag: keep it playing, or set the parameter recorded"
            raise NotYet(
                Code.STALE_DATA,
                f"age of the objects in s, by {by}",
                round(age, 1),
                f"at most {limits.objects_age:g}, by stamp and by arrival, and at most {AHEAD:g} ahead{hint}",
            )
    return world.scene


def _arm(claim: Claim, world: World, limits: Limits, purpose: Purpose) -> tuple[str, ...]:
    """The arm stands at the start of what it is to do next."""
    if not claim.joints:
        return ()
    if not claim.state_known and not any(name in world.joints for name in claim.joints) and purpose is not Purpose.MOVE:
        return (ARM_UNKNOWN,)
    any_age = world.recorded or purpose is Purpose.STAND
    try:
        check_start(
            claim.joints,
            claim.start,
            world.joints,
            world.clock,
            world.now,
            limits.start_tolerance,
            np.inf if any_age else limits.state_age,
            by_stamp=not any_age and not world.replaying,
        )
    except MagicError as error:
        if error.code == Code.STALE_DATA:
            raise NotYet(error.code, error.message) from error
        raise
    return ()


class Exchange:
    """Who can have answered a request: the one server that there was from before it was sent until after its answer came.

    ``servers``: who serves it before the request is sent.  A server may be out of sight for a moment; another one may not be in
    sight in any.  Where the middleware does not tell who serves what, they are told apart by number alone.
    """

    def __init__(self, name: str, servers: frozenset[bytes]) -> None:
        check_single({name: servers})
        self._name = name
        self._asked = self._met = servers

    def look(self, servers: frozenset[bytes]) -> None:
        """Take in who is there while the answer is waited for."""
        self._met |= servers

    def end(self, servers: frozenset[bytes]) -> bytes:
        """The one that was asked, now that the answer has come; raises NOT_ALONE where another one has been there."""
        self.look(servers)
        check_single({self._name: self._met})
        return next(iter(self._asked), b"")
