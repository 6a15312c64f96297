"""The grasps that may serve a request, best first, in lots: what they must stay clear of, and how hard they are looked for."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_planner.collision import Body, grown, mass_centre, solid_pieces
from magic_planner.grasps import Grasp, GraspSettings, collision_free, propose, surface
from magic_planner.margins import grip_at_rest
from magic_planner.request import ArmSettings, Request
from magic_planner.robot import Robot

Array = NDArray[np.float64]
#: How many of the motion's poses the hand's height over the table, and its way through other things' points, are looked at.
HEIGHTS, PASSES = 10, 7
#: How many times as many grasps are looked at in the closer of the two looks.
CLOSER = 4
#: Points on each other thing for the first test of the hand.
POINTS = 200
#: Grasps whose hand comes within so many metres of where the target lies in the tool stand back by so much: the target rolls about
#: there.  So do those whose open hand comes within so many metres of the tool, as it is that far off where it was sent: what it brushes
#: is pushed over, or dragged along, before the fingers close.
BESIDE, BRUSHED, BACK = 0.01, 0.002, 5.0


class GraspChoice:
    """Chooses grasps for one request."""

    def __init__(
        self,
        robot: Robot,
        grasping: GraspSettings,
        settings: ArmSettings,
        request: Request,
        tool_from_contact: Array,
        tool_from_target: Array | None = None,
    ) -> None:
        """tool_from_target (4, 4): where the target is in the tool where their contacts meet; ``None``
        where no contact of the target is known."""
        self.tool_from_target = tool_from_target
        self.robot, self.settings, self.request, self.tool_from_contact = robot, settings, request, tool_from_contact
        self.fixed = request.strategy.physics.target_is_fixed
        self.last = len(request.poses) - 1
        self.met = min(int(np.searchsorted(request.times, request.met)), self.last)
        self.grasping = replace(grasping, density=request.strategy.physics.tool_density, force=self._force(), standoff=settings.standoff)
        keys = request.poses[request.keys]
        some = np.unique(np.linspace(0, len(keys) - 1, min(HEIGHTS, len(keys))).astype(int))
        self.poses = np.concatenate([request.tool.world_from_object[None], keys[some]])
        self.static, self.swept = self._points()

    def lots(self) -> Iterator[list[Grasp]]:
        """Grasps whose open hand is clear of everything and whose grip holds the tool at least at rest, in lots of no more than the
        settings' sizes: those of a quick look, and where none of them serves those of a closer one; raises NO_GRASP where there is none."""
        problem: MagicError | None = None
        held = False
        for finer, sizes in ((1, self.settings.lots), (CLOSER, self.settings.closer)):
            self.request.budget.check("grasp")
            try:
                grasps = self._proposed(finer)
            except MagicError as error:
                if error.code != Code.NO_GRASP:
                    raise
                problem = error
                continue
            blocked: dict[str, int] = {}
            free = collision_free(
                self.robot,
                self._with_room(grasps),
                self.request.tool,
                self._checks(),
                blocked,
                self.request.budget,
                self.settings.standoff / 2,
            )
            shares: list[Array] = []
            for size in sizes:
                if lot := list(itertools.islice(free, size)):
                    shares.append(self._at_rest(lot))
                    if kept := [grasp for grasp, share in zip(lot, shares[-1], strict=True) if share <= 1]:
                        held = True
                        yield kept
            if shares:
                every = np.concatenate(shares)
                problem = MagicError(
                    Code.NO_GRASP,
                    f"stage grasp: margin of grip: {100 * every.min():.0f} % of what pads pressed with {self.grasping.grip_force:g} N hold, "
                    f"at rest, in the best of {len(every)} grasps of {self.request.tool.id}",
                    f"{100 * (1 - every.min()):.0f} % left",
                    "0 % or more",
                )
                continue
            name = max(blocked, key=lambda k: blocked[k])
            problem = MagicError(
                Code.NO_GRASP,
                f"stage grasp: {len(grasps)} grasps of {self.request.tool.id}",
                f"hand and {name} in collision for {blocked[name]} of them",
                "an open hand clear of everything",
            )
        if not held:
            assert problem is not None
            raise problem

    def _proposed(self, finer: int) -> list[Grasp]:
        request, settings = self.request, self.grasping
        closer = replace(
            settings,
            samples=settings.samples * finer,
            pairs=settings.pairs * finer,
            enough=settings.enough * finer,
            looked=settings.looked * finer,
            angles=settings.angles * (2 if finer > 1 else 1),
        )
        given = (self.robot, request.tool, self.tool_from_contact, request.plane, self.poses, closer, request.seed)
        return propose(*given, self.static, self.swept, request.budget)

    def _force(self) -> float:
        """Newtons on the contact: what moves the target along the table, or holds the tool up where the target is fixed."""
        physics = self.request.strategy.physics
        loaded, density = (self.request.tool, physics.tool_density) if self.fixed else (self.request.target, 2 * physics.target_density)
        return float(np.clip(mass_centre(solid_pieces(loaded))[0] * density * 9.81, 0.5, 30.0))

    def _at_rest(self, lot: list[Grasp]) -> Array:
        """(G,): the share of their grip that grasps need however slowly the tool is taken along its task."""
        request = self.request
        times = request.times[request.keys]
        pushed = np.zeros(len(times), dtype=bool)
        for phase in request.motion.phases:
            if phase.name in ("contact", "goal"):
                pushed |= (times >= phase.start) & (times < phase.end)
        frames = np.stack([grasp.tool_from_tcp for grasp in lot])
        poses = request.poses[request.keys]
        return grip_at_rest(self.robot, self.grasping, request.tool, frames, self.tool_from_contact, poses, pushed)

    def _with_room(self, grasps: list[Grasp]) -> list[Grasp]:
        """The grasps, those last whose hand would be in the way of a target that the tool takes along, or hardly has room for the tool.
        A ball that is met with a scoop's lip rolls on to the place that was matched, and lay on the fingers there."""
        hand, wide = self.robot.hand_body(), Body("hand", grown(self.robot.hand.values(), BRUSHED))
        tool = Body(self.request.tool.id, solid_pieces(self.request.tool))
        pairs = [(wide, tool)]
        if self.tool_from_target is not None and not self.fixed:
            target = Body(self.request.target.id, grown(solid_pieces(self.request.target), BESIDE))
            target.move(self.tool_from_target)
            pairs.append((hand, target))

        def in_the_way(grasp: Grasp) -> bool:
            hand.move(grasp.tool_from_tcp)
            wide.move(grasp.tool_from_tcp)
            return any(one.touches(other) for one, other in pairs)

        # In the order that they have, which is not quite that of their costs.
        costs = np.maximum.accumulate([grasp.cost for grasp in grasps])
        ranks = costs + BACK * np.array([in_the_way(grasp) for grasp in grasps])
        return [grasps[index] for index in np.argsort(ranks, kind="stable")]

    def _there(self, index: int) -> bool:
        """Whether the target is where it was when the motion's pose ``index`` is reached: once
        touched it goes along, unless it is fixed."""
        return self.fixed or index <= self.met

    def _points(self) -> tuple[Array, Array]:
        """Points (N, 3) of the other things, in the tool's frame, as :func:`magic_planner.grasps.in_the_way` wants them."""
        request = self.request
        rng = np.random.default_rng(request.seed)
        clouds = {}
        for item in (request.target, *request.obstacles):
            on = transforms.apply(item.world_from_object, surface(solid_pieces(item), POINTS, rng)[0])
            clouds[item.id] = np.concatenate([on, request.cloud.get(item.id, np.zeros((0, 3)))])
        static = [np.zeros((0, 3))]
        swept = [transforms.apply(transforms.inverse(request.tool.world_from_object), np.concatenate(list(clouds.values())))]
        for index in np.unique([*np.linspace(0, self.last, PASSES).astype(int), self.met]):
            if there := [cloud for name, cloud in clouds.items() if name != request.target.id or self._there(index)]:
                points = transforms.apply(transforms.inverse(request.poses[index]), np.concatenate(there))
                (swept if request.strategy.releases and index == self.last else static).append(points)
        return np.concatenate(static), np.concatenate(swept)

    def _checks(self) -> list[tuple[Array, list[Body]]]:
        """Poses of the tool, and the bodies of which the hand must be clear there."""
        request = self.request
        target, others = Body.from_object(request.target), [Body.from_object(o) for o in request.obstacles]
        checks = [(request.tool.world_from_object, [target, *others])]
        for index in sorted({0, self.met, self.last}):
            checks.append((request.poses[index], [target, *others] if self._there(index) else others))
        return checks
