"""How the arm takes the tool along: grasp, lift, transfer, the task itself, retreat.

The tool's motion is given (:mod:`magic_planner.object_motion`) and a grasp is rigid,
so the hand's path is known for each grasp before anything is planned.  The search
therefore starts at the far end: grasps whose hand can follow the whole task come
first, and only for those are the pick-up and the free motion planned.  What fails
is kept with its stage, and the failure that came furthest is the one reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_planner import timing
from magic_planner.budget import Budget
from magic_planner.cloud import CloudSettings, cloud_name, unexplained
from magic_planner.collision import Body, grown, mass_centre, shell, solid_pieces
from magic_planner.grasps import Grasp, GraspSettings, collision_free, propose, surface
from magic_planner.object_motion import table_plane, tool_contact_frame, turning, waypoint_times
from magic_planner.robot import Robot

Array = NDArray[np.float64]
#: Searches for one free path, each with its own random numbers.
SEARCHES = 3
#: The stages of a plan in the order in which they are decided: a later one is a better failure.
STAGES = ("motion", "grasp", "task", "approach", "lift", "transfer", "retreat", "timing")


@dataclass(frozen=True)
class ArmSettings:
    """key_length, key_angle: spacing of the poses at which grasps are compared.  grasps: how many are compared at once, rounds:
    how many such lots.  tries: complete plans tried.  standoff: metres before the grasp from which the hand comes straight.
    lift, retreat: metres.  room: metres about a tool that is carried.  dwell: seconds for the fingers to close or open.  jump: largest joint step between
    neighbouring key poses, rad.  time_step of the result, s.  free_time: seconds for one search of a free path
    (searches take some 20 ms; the limit is wide so that a loaded machine finds the same path)."""

    key_length: float = 0.02
    key_angle: float = np.deg2rad(8.0)
    grasps: int = 40
    rounds: int = 3
    tries: int = 10
    standoff: float = 0.08
    lift: float = 0.06
    retreat: float = 0.08
    room: float = 0.015
    dwell: float = 0.5
    jump: float = 0.5
    time_step: float = 0.02
    free_time: float = 1.0


@dataclass(frozen=True)
class Branch:
    """One way to take the tool along the key poses: which grasp, and the joint positions (K, J)."""

    grasp: Grasp
    path: Array
    cost: float


@dataclass
class Request:
    """What one call of :meth:`ArmPlanner.plan` works on."""

    strategy: Strategy
    tool: SceneObject
    target: SceneObject
    obstacles: tuple[SceneObject, ...]
    motion: ToolMotion
    plane: Array
    start: Array
    seed: int
    budget: Budget
    feedback: Callable[[str, str], None]
    times: Array  # (T,) of the task: the tool's motion up to the release
    poses: Array  # (T, 4, 4)
    keys: NDArray[np.int64]  # (K,) indices into times
    met: float  # seconds at which the tool meets the target
    shapes: list[Any]  # the tool's surface
    marks: tuple[tuple[str, float], ...]  # names of the places the tool's motion passes, and when
    cloud: dict[str, Array]  # by object: measured points (N, 3) that no shape accounts for
    _grown: dict[float, list[Any]] = field(default_factory=dict)

    def roomy(self, margin: float) -> list[Any]:
        """The tool's surface grown by ``margin`` metres."""
        if margin <= 0:
            return self.shapes
        if margin not in self._grown:
            self._grown[margin] = shell(grown(solid_pieces(self.tool), margin))
        return self._grown[margin]

    def surroundings(self, target: bool = True) -> list[str]:
        """Names of all that is in the collision world besides table and tool; without the target on request."""
        items = (self.target, *self.obstacles) if target else self.obstacles
        return [item.id for item in items] + [cloud_name(item) for item in items if item.id in self.cloud]

    def place(self, index: int) -> str:
        """A sentence's name for a sample of the task: the waypoint it leads to."""
        now = float(self.times[index])
        marks = self.marks
        name = next((n for n, t in marks if t >= now - 1e-6), marks[-1][0])
        return f"waypoint {name!r} (at {now:.2f} s of the tool's motion)"


class Failures:
    """The failures of the tries, of which the one that came furthest counts."""

    def __init__(self) -> None:
        self._best: tuple[int, MagicError] | None = None
        self.count = 0

    def add(self, stage: str, error: MagicError) -> None:
        """Note that a try ended at a stage."""
        self.count += 1
        rank = STAGES.index(stage)
        if self._best is None or rank > self._best[0]:
            self._best = (rank, error)

    def error(self) -> MagicError:
        """The failure to report."""
        assert self._best is not None
        rank, error = self._best
        tail = f"; {self.count} tries failed, this one came furthest" if self.count > 1 else ""
        return MagicError(error.code, f"stage {STAGES[rank]}: {error.message}{tail}")


class ArmPlanner:
    """Plans arm motions for one robot.  One request at a time; the same request and seed give the same plan."""

    def __init__(
        self,
        robot: Robot,
        settings: ArmSettings | None = None,
        grasping: GraspSettings | None = None,
        cloud: CloudSettings | None = None,
    ) -> None:
        self.robot = robot
        self.cloud = cloud or CloudSettings()
        self.settings = settings or ArmSettings()
        self.grasping = grasping or GraspSettings()

    def warm_up(self) -> None:
        """Load and build what the first request would otherwise wait for."""
        self.robot.warm_up()
        timing.parameterise(
            np.stack([self.robot.home, self.robot.home + 0.05]), self.robot.velocity_limits, self.robot.acceleration_limits, 0.02
        )

    # ------------------------------------------------------------ one request

    def plan(
        self,
        strategy: Strategy,
        tool: SceneObject,
        target: SceneObject,
        candidate: ContactCandidate,
        reflection: str,
        motion: ToolMotion,
        table: Array | Sequence[float] = (0.0, 0.0, 1.0, 0.0),
        obstacles: Sequence[SceneObject] = (),
        start: Array | None = None,
        attempt: int = 0,
        seed: int = 0,
        budget: Budget | None = None,
        feedback: Callable[[str, str], None] = lambda stage, message: None,
    ) -> MotionPlan:
        """The arm's motion that takes the tool from where it lies along ``motion``.

        start (J,): where the arm is (default: home).  attempt: 0 for the best grasp, n for the n-th next that differs from
        those before.  A tool's retreat that the arm cannot follow is left out.

        Raises NO_GRASP, NO_IK, JOINT_LIMIT, START_IN_COLLISION, PATH_IN_COLLISION, NO_PATH, DYNAMIC_LIMIT,
        TIME_PARAMETERISATION, PLANNING_TIMEOUT, CANCELED, each naming the stage and the waypoint, pair or limit.
        """
        budget = budget or Budget()
        given = (strategy, tool, target, candidate, reflection)
        rest = (table, obstacles, start, attempt, seed, budget, feedback)
        try:
            return self._plan(*given, motion, *rest)
        except MagicError as error:
            ending = next((p for p in motion.phases if p.name == "retreat"), None)
            if ending is None or strategy.releases or error.code not in (Code.NO_IK, Code.JOINT_LIMIT, Code.PATH_IN_COLLISION):
                raise
            # What the tool is for is done by then: better to stop there than not to act.
            feedback("task", f"without the tool's retreat, as {error.message}")
            until = motion.times <= ending.start + 1e-9
            shorter = ToolMotion(
                motion.times[until],
                motion.world_from_tool[until],
                tuple(p for p in motion.phases if p.end <= ending.start + 1e-9),
                tuple(m for m in motion.marks if m[1] <= ending.start + 1e-9),
            )
            return self._plan(*given, shorter, *rest)

    def _plan(
        self,
        strategy: Strategy,
        tool: SceneObject,
        target: SceneObject,
        candidate: ContactCandidate,
        reflection: str,
        motion: ToolMotion,
        table: Array | Sequence[float],
        obstacles: Sequence[SceneObject],
        start: Array | None,
        attempt: int,
        seed: int,
        budget: Budget,
        feedback: Callable[[str, str], None],
    ) -> MotionPlan:
        robot = self.robot
        start = robot.home.copy() if start is None else np.asarray(start, dtype=float)
        if start.shape != (robot.count,) or not np.all(np.isfinite(start)):
            raise MagicError(Code.BAD_REQUEST, "start configuration", start.tolist(), f"{robot.count} finite joint positions")
        over = np.flatnonzero((start < robot.chain.lower - 1e-3) | (start > robot.chain.upper + 1e-3))
        if len(over):
            j = int(over[0])
            raise MagicError(
                Code.JOINT_LIMIT,
                f"start, {robot.chain.names[j]}",
                round(float(start[j]), 4),
                f"{robot.chain.lower[j]} to {robot.chain.upper[j]} rad",
            )
        release = next((p.start for p in motion.phases if p.name == "release"), None) if strategy.releases else None
        count = len(motion.times) if release is None else int(np.searchsorted(motion.times, release + 1e-9))
        times, poses = motion.times[:count], motion.world_from_tool[:count]
        plane = table_plane(table)
        request = Request(
            strategy=strategy,
            tool=tool,
            target=target,
            obstacles=tuple(obstacles),
            motion=motion,
            plane=plane,
            start=start,
            seed=seed,
            budget=budget,
            feedback=feedback,
            times=times,
            poses=poses,
            keys=self._keys(poses),
            met=next((p.start for p in motion.phases if p.name in ("contact", "goal")), float(times[-1])),
            shapes=shell(solid_pieces(tool)),
            marks=motion.marks or waypoint_times(strategy),
            cloud=unexplained((target, *obstacles), tool, plane, self.cloud),
        )
        self._build_world(request)
        robot.open_to(robot.config.opening)
        pair = robot.collision(start)
        if pair is not None:
            raise MagicError(Code.START_IN_COLLISION, "stage approach: the arm at its start", str(pair), "a start clear of everything")

        feedback("grasp", "looking for grasps that serve the whole motion")
        failures = Failures()
        grasps = self._grasps(request, tool_contact_frame(candidate, reflection))
        chosen: list[Array] = []  # grasps of the attempts before, in order
        spare: list[list[Branch]] = []  # those that close where one of these does, only from another side
        tried = 0
        for lot in [*range(0, len(grasps), self.settings.grasps), -1]:
            if lot >= 0:
                budget.check("task")
                feedback("task", f"following the task with grasps {lot} to {min(lot + self.settings.grasps, len(grasps)) - 1}")
                branches = self._branches(request, grasps[lot : lot + self.settings.grasps], failures)
                groups = _by_grasp(self._clear(request, branches, failures))
            else:
                groups = spare
            for group in groups:
                frame = group[0].grasp.tool_from_tcp
                if groups is not spare and any(_same_place(frame, other, robot.closing) for other in chosen):
                    spare.append(group)
                    continue
                if any(_alike(frame, other) for other in chosen):
                    continue
                for branch in group[:3]:
                    if tried >= self.settings.tries:
                        raise failures.error()
                    tried += 1
                    try:
                        plan = self._complete(request, branch, len(chosen) < attempt)
                    except StageError as failure:
                        failures.add(failure.stage, failure.error)
                        if failure.stage == "approach" and failure.error.code == Code.PATH_IN_COLLISION:
                            break  # the same hand comes to the same grasp in the group's other branches
                        continue
                    chosen.append(frame)
                    if plan is not None:
                        return plan
                    tried -= 1
                    break
        if chosen:
            raise MagicError(
                Code.NO_GRASP, "stage grasp: attempt", attempt, f"0 to {len(chosen) - 1}: there are {len(chosen)} different grasps"
            )
        raise failures.error()

    def _keys(self, poses: Array) -> NDArray[np.int64]:
        """Indices of task poses at most key_length and key_angle apart, the first and last among them."""
        keys = [0]
        while keys[-1] < len(poses) - 1:
            rest = poses[keys[-1] + 1 : keys[-1] + 65]
            far = np.linalg.norm(rest[:, :3, 3] - poses[keys[-1], :3, 3], axis=1) > self.settings.key_length
            far |= turning(poses[keys[-1]], rest) > self.settings.key_angle
            keys.append(keys[-1] + (max(1, int(far.argmax())) if far.any() else len(rest)))
        return np.array(keys)

    def _build_world(self, request: Request) -> None:
        robot = self.robot
        robot.clear()
        robot.add_table(request.plane)
        for item in (request.target, *request.obstacles):
            robot.add(item.id, shell(solid_pieces(item)), item.world_from_object)
            if item.id in request.cloud:
                robot.add_cloud(cloud_name(item), request.cloud[item.id], self.cloud.resolution)
        robot.add(request.tool.id, request.shapes, request.tool.world_from_object)

    # ------------------------------------------------------------ grasps and the task

    def _grasps(self, request: Request, tool_from_contact: Array) -> list[Grasp]:
        keys = request.poses[request.keys]
        some = keys[np.unique(np.linspace(0, len(keys) - 1, min(10, len(keys))).astype(int))]
        poses = np.concatenate([request.tool.world_from_object[None], some])
        fixed = request.strategy.physics.target_is_fixed
        target = Body.from_object(request.target)
        others = [Body.from_object(o) for o in request.obstacles]
        met = int(np.searchsorted(request.times, request.met))
        last = len(request.poses) - 1
        # The force on the contact: what moves the target along the table, or holds the tool up where the target is fixed.
        loaded, density = (
            (request.tool, request.strategy.physics.tool_density)
            if fixed
            else (request.target, 2 * request.strategy.physics.target_density)
        )
        force = float(np.clip(mass_centre(solid_pieces(loaded))[0] * density * 9.81, 0.5, 30.0))
        settings = replace(self.grasping, density=request.strategy.physics.tool_density, force=force, standoff=self.settings.standoff)
        rng = np.random.default_rng(request.seed)
        clouds = {
            item.id: np.concatenate(
                [
                    transforms.apply(item.world_from_object, surface(solid_pieces(item), 200, rng)[0]),
                    request.cloud.get(item.id, np.zeros((0, 3))),
                ]
            )
            for item in (request.target, *request.obstacles)
        }
        static, swept = [], [transforms.apply(transforms.inverse(request.tool.world_from_object), np.concatenate(list(clouds.values())))]
        for index in np.unique([*np.linspace(0, last, 7).astype(int), min(met, last)]):
            # Once it is touched the target goes with the tool, unless it is fixed.
            there = [cloud for name, cloud in clouds.items() if fixed or name != request.target.id or index <= met]
            if there:
                final = request.strategy.releases and index == last
                (swept if final else static).append(transforms.apply(transforms.inverse(request.poses[index]), np.concatenate(there)))
        swept_points, static_points = np.concatenate(swept), np.concatenate(static) if static else np.zeros((0, 3))
        grasps = propose(
            self.robot,
            request.tool,
            tool_from_contact,
            request.plane,
            poses,
            settings,
            request.seed,
            static_points,
            swept_points,
            request.budget,
        )
        checks = [(request.tool.world_from_object, [target, *others])]
        for index in sorted({0, min(met, last), last}):
            checks.append((request.poses[index], [target, *others] if fixed or index <= met else others))
        free, blocked = collision_free(
            self.robot,
            grasps,
            request.tool,
            checks,
            self.settings.grasps * self.settings.rounds,
            request.budget,
            way=self.settings.standoff / 2,
        )
        if not free:
            name = max(blocked, key=lambda k: blocked[k])
            raise MagicError(
                Code.NO_GRASP,
                f"stage grasp: {len(grasps)} grasps of {request.tool.id}",
                f"hand and {name} in collision for {blocked[name]} of them",
                "an open hand clear of everything",
            )
        return free

    def _branches(self, request: Request, grasps: Sequence[Grasp], failures: Failures) -> list[Branch]:
        """Every way found to follow the key poses with these grasps, best first."""
        robot, settings = self.robot, self.settings
        keys = request.poses[request.keys]
        frames = np.stack([g.tool_from_tcp for g in grasps])
        index, q = robot.inverse(keys[0] @ frames, np.stack([robot.home, request.start]))
        if not len(index):
            failures.add(
                "task",
                MagicError(
                    Code.NO_IK,
                    f"{request.place(0)}: {len(grasps)} grasps",
                    "none within the arm's reach",
                    f"a hand within {robot.chain.reach:.2f} m of the base, at a pose that the joint limits allow",
                ),
            )
            return []
        targets = keys[:, None] @ frames[index][None]
        paths, stopped, reason = robot.chain.track(targets, q, jump=settings.jump)
        whole = stopped == len(keys)
        if not whole.any():
            best = int(stopped.argmax())
            where = request.place(int(request.keys[stopped[best]]))
            why = int(reason[best])
            ways = f"{len(index)} postures with {len(grasps)} grasps"
            if why >= 0:
                failures.add(
                    "task",
                    MagicError(
                        Code.JOINT_LIMIT,
                        f"{where}, {robot.chain.names[why]}",
                        f"at its limit for the best of {ways}",
                        f"{robot.chain.lower[why]:.3f} to {robot.chain.upper[why]:.3f} rad",
                    ),
                )
            else:
                failures.add(
                    "task",
                    MagicError(
                        Code.NO_IK,
                        f"{where}: {ways}",
                        "out of reach" if why == -1 else "only by a jump of the joints",
                        f"a path that the arm can follow, joint steps below {settings.jump} rad",
                    ),
                )
            return []
        branches = []
        for n in np.flatnonzero(whole):
            path = paths[:, n]
            slack = np.minimum(path - robot.chain.lower, robot.chain.upper - path).min()
            way = np.abs(np.diff(path, axis=0)).max(axis=1).sum() if len(path) > 1 else 0.0
            far = np.abs(path[0] - request.start).max()
            cost = grasps[index[n]].cost + 0.15 * way + 0.1 * far + 0.3 * max(0.0, 0.3 - slack)
            branches.append(Branch(grasps[index[n]], path, float(cost)))
        return sorted(branches, key=lambda b: b.cost)

    def _clear(self, request: Request, branches: Sequence[Branch], failures: Failures) -> list[Branch]:
        """The branches whose arm, seen without the tool, is clear of everything at every key pose; best first, no more than are tried."""
        robot = self.robot
        robot.detach()
        if robot.world.has_object(request.tool.id):
            robot.world.remove_object(request.tool.id)
        robot.open_to(robot.config.opening)
        times = request.times[request.keys]
        fixed = request.strategy.physics.target_is_fixed
        clear: list[Branch] = []
        # Where one branch fails others fail too: the places of the last failures are looked at first.
        order = list(range(len(request.keys)))
        for n, branch in enumerate(branches):
            if n % 8 == 0:
                request.budget.check("task")
            hit = None
            for place, k in enumerate(order):
                self._ignore_target(request, not fixed and bool(times[k] > request.met + 1e-9))
                if robot.collides(branch.path[k]):
                    hit = (k, robot.collision(branch.path[k]))
                    order.insert(0, order.pop(place))
                    break
            if hit is None:
                clear.append(branch)
                if len(clear) >= 4 * self.settings.tries:
                    break
            else:
                failures.add(
                    "task",
                    MagicError(
                        Code.PATH_IN_COLLISION,
                        f"{request.place(int(request.keys[hit[0]]))}: {hit[1]}",
                        "in collision",
                        "a task path clear of the arm",
                    ),
                )
        self._ignore_target(request, False)
        return clear

    def _complete(self, request: Request, branch: Branch, only_check: bool) -> MotionPlan | None:
        """The whole plan for one branch, or (``only_check``) None once pick-up and task are known to be possible; raises StageError."""
        self._check_task(request, branch)
        pick = self._pick(request, branch)
        task = self._follow(request, branch)
        retreat = self._retreat(request, branch, task) if request.strategy.releases else None
        if only_check:
            return None
        request.feedback("transfer", "free motion with the tool in hand")
        carry = self._carry(request, branch, pick[2][-1], task[0])
        request.feedback("approach", "free motion to the tool")
        come = self._come(request, pick[0][0])
        request.feedback("timing", "time parameterisation")
        return self._timed(request, branch, come, pick, carry, task, retreat)

    def _hold(self, request: Request, grasp: Grasp, shapes: list[Any] | None = None) -> None:
        """The world with the tool (or other shapes in its frame) in the closed hand; it may touch nothing else yet."""
        robot, name = self.robot, request.tool.id
        robot.detach()
        if robot.world.has_object(name):
            robot.world.remove_object(name)
        robot.open_to(grasp.width)
        robot.attach(name, shapes or request.shapes, transforms.inverse(grasp.tool_from_tcp), tuple(robot.hand))
        robot.allow(name, "table", *request.surroundings(), allowed=False)
        self._ignore_target(request, False)

    def _lay(self, request: Request, pose: Array) -> None:
        """The world with the tool lying at a pose and the hand open about it; only the fingers may touch it."""
        robot, name = self.robot, request.tool.id
        robot.detach()
        robot.open_to(robot.config.opening)
        robot.add(name, request.shapes, pose)
        robot.allow(name, *robot.finger_links)
        robot.allow(name, "table", *request.surroundings())
        self._ignore_target(request, False)

    def _ignore_target(self, request: Request, ignored: bool) -> None:
        links = list(self.robot.planner.user_link_names)
        self.robot.allow(request.target.id, *links, allowed=ignored)
        if request.target.id in request.cloud:
            self.robot.allow(cloud_name(request.target), *links, allowed=ignored)

    def _check_task(self, request: Request, branch: Branch) -> None:
        robot = self.robot
        self._hold(request, branch.grasp)
        # The tool's own contacts are the task; physics judges them.  The arm's are not allowed.
        robot.allow(request.tool.id, "table", *request.surroundings())
        met = int(np.searchsorted(request.times[request.keys], request.met + 1e-9))
        fixed = request.strategy.physics.target_is_fixed
        before = len(branch.path) if fixed else max(1, met)
        hit = robot.first_collision(branch.path[:before], budget=request.budget, stage="task")
        if hit is None and before < len(branch.path):
            self._ignore_target(request, True)
            hit = robot.first_collision(branch.path[before - 1 :], budget=request.budget, stage="task")
            hit = None if hit is None else (hit[0] + before - 1, hit[1])
        if hit is not None:
            raise StageError(
                "task",
                MagicError(
                    Code.PATH_IN_COLLISION,
                    f"{request.place(int(request.keys[hit[0]]))}: {hit[1]}",
                    "in collision",
                    "a task path clear of the arm",
                ),
            )

    def _follow(self, request: Request, branch: Branch) -> Array:
        """Joint positions (T, J) at every sample of the task: between the key poses by interpolation, then onto the path, all at once."""
        chain = self.robot.chain
        targets = request.poses @ branch.grasp.tool_from_tcp
        if len(request.keys) < 2:
            return np.repeat(branch.path[:1], len(targets), axis=0)
        q = np.stack([np.interp(np.arange(len(targets)), request.keys, branch.path[:, j]) for j in range(chain.count)], axis=1)
        q, solved = chain.solve(targets, q, iterations=12, position=1e-6, angle=1e-5)
        if not solved.all():
            where = request.place(int(np.argmin(solved)))
            raise StageError("task", MagicError(Code.NO_IK, where, "out of reach between the key poses", "a path that the arm can follow"))
        step = np.abs(np.diff(q, axis=0)).max(axis=1)
        if step.max() > self.settings.jump / 2:
            where = request.place(int(step.argmax()) + 1)
            raise StageError(
                "task", MagicError(Code.NO_IK, where, f"a jump of {step.max():.2f} rad", f"joint steps below {self.settings.jump / 2} rad")
            )
        return q

    # ------------------------------------------------------------ picking up

    def _straight(self, start: Array, shift: Array, q: Array) -> list[Array | None]:
        """Joint paths from each of q (N, J) along a straight move of the hand by ``shift`` (3,) metres, base axes; None where one
        cannot follow."""
        parts = max(2, int(np.ceil(np.linalg.norm(shift) / 0.01))) + 1
        targets = np.repeat(start[None], parts, axis=0)
        targets[:, :3, 3] += np.linspace(0, 1, parts)[:, None] * shift
        paths, stopped, _ = self.robot.chain.track(np.repeat(targets[:, None], len(q), axis=1), q, jump=self.settings.jump)
        return [paths[:, n] if stopped[n] == parts else None for n in range(len(q))]

    def _pick(self, request: Request, branch: Branch) -> tuple[Array, Array, Array]:
        """Joint paths of coming to the grasp (n, J), the grasp itself (J,) and the lift (m, J)."""
        robot, settings = self.robot, self.settings
        request.feedback("lift", "picking the tool up")
        tip = request.tool.world_from_object @ branch.grasp.tool_from_tcp
        _, solutions = robot.inverse(tip[None], np.stack([branch.path[0], request.start]), seeds=16)
        if not len(solutions):
            raise StageError(
                "approach",
                MagicError(Code.NO_IK, f"the grasp of {request.tool.id} where it lies", "out of reach", "a tool that the arm can reach"),
            )
        # The posture nearest to both neighbours costs the least motion.
        far = np.abs(solutions - branch.path[0]).max(axis=1) + np.abs(solutions - request.start).max(axis=1)
        problem: StageError | None = None
        ways: list[tuple[Array, Array]] = []
        self._lay(request, request.tool.world_from_object)
        solutions = solutions[np.argsort(far, kind="stable")][:8]
        backs = [self._straight(tip, -share * settings.standoff * tip[:3, 2], solutions) for share in (1.0, 0.5)]
        for n, q in enumerate(solutions):
            request.budget.check("approach")
            for back in (backs[0][n], backs[1][n]):
                if back is None:
                    problem = problem or StageError(
                        "approach",
                        MagicError(
                            Code.NO_IK,
                            f"coming straight to the grasp of {request.tool.id}",
                            "out of reach",
                            f"{settings.standoff} m of straight way",
                        ),
                    )
                    continue
                hit = robot.first_collision(back[::-1], budget=request.budget, stage="approach")
                if hit is None:
                    ways.append((back[::-1], q))
                    break
                problem = StageError(
                    "approach",
                    MagicError(Code.PATH_IN_COLLISION, f"coming to the grasp: {hit[1]}", "in collision", "a clear way to the tool"),
                )
            if len(ways) >= 3:
                break
        self._hold(request, branch.grasp)
        # The tool leaves what it lies on.
        robot.allow(request.tool.id, "table", *request.surroundings())
        for back, q in ways:
            for height in (settings.lift, settings.lift / 2):
                up = self._straight(tip, height * request.plane[:3], q[None])[0]
                if up is None:
                    problem = StageError(
                        "lift",
                        MagicError(
                            Code.NO_IK, f"lifting {request.tool.id} by {height:.2f} m", "out of reach", "a lift that the arm can follow"
                        ),
                    )
                    continue
                hit = robot.first_collision(up, budget=request.budget, stage="lift")
                if hit is None:
                    return back, q, up
                problem = StageError(
                    "lift", MagicError(Code.PATH_IN_COLLISION, f"lifting {request.tool.id}: {hit[1]}", "in collision", "a clear lift")
                )
        assert problem is not None
        raise problem

    # ------------------------------------------------------------ free motion

    def _come(self, request: Request, goal: Array) -> Array:
        self._lay(request, request.tool.world_from_object)
        self.robot.allow(request.tool.id, *self.robot.finger_links, allowed=False)
        return self._free(request, request.start, goal, "approach")

    def _carry(self, request: Request, branch: Branch, start: Array, goal: Array) -> Array:
        robot = self.robot
        self._hold(request, branch.grasp)
        for q, what in ((start, "lifted"), (goal, "at the start of the task")):
            pair = robot.collision(q)
            if pair is not None:
                raise StageError(
                    "transfer",
                    MagicError(
                        Code.PATH_IN_COLLISION, f"the tool {what}: {pair}", "in collision", "a tool in the hand clear of everything"
                    ),
                )
        # A tool shifts a little in the hand when it is gripped: it is carried with room about it, where its ends leave that.
        for room in (self.settings.room, self.settings.room / 3):
            self._hold(request, branch.grasp, request.roomy(room))
            robot.allow(request.tool.id, "table")
            if robot.collides(start) or robot.collides(goal):
                continue
            try:
                path = self._free(request, start, goal, "transfer")
            except StageError:
                continue
            # What was left out: the table, above which the task may begin by a hair.
            self._hold(request, branch.grasp)
            if robot.first_collision(timing.swept(path, 0.03), budget=request.budget, stage="transfer") is None:
                return path
        self._hold(request, branch.grasp)
        return self._free(request, start, goal, "transfer")

    def _free(self, request: Request, start: Array, goal: Array, stage: str) -> Array:
        """A collision-free joint path (n, J): straight where that is free, else by RRT-Connect and shortened."""
        import mplib

        robot = self.robot
        line = np.stack([start, goal])
        if robot.first_collision(line, step=0.03, budget=request.budget, stage=stage) is None:
            return line
        pair = robot.collision(start) or robot.collision(goal)
        if pair is not None:
            raise StageError(stage, MagicError(Code.PATH_IN_COLLISION, f"an end of the free motion: {pair}", "in collision", "free ends"))
        rng = np.random.default_rng([request.seed, STAGES.index(stage)])
        for n in range(SEARCHES):
            request.budget.check(stage)
            mplib.set_global_seed(int(request.seed) % 100_000 * 10 + n + 1)
            seconds = min(self.settings.free_time, max(0.05, request.budget.left))
            status, path = robot.planner.planner.plan(start, [goal], time=seconds, range=0.3, simplify=False)
            if not str(status).startswith("Exact"):
                continue
            path = np.asarray(path, dtype=float)
            # OMPL checks edges coarsely, and a spline swings out at corners; what that meets is found here.
            for shorter in (_shorten(robot, path, rng, request.budget, stage), path):
                if robot.first_collision(timing.swept(shorter, 0.03), budget=request.budget, stage=stage) is None:
                    return shorter
        raise StageError(
            stage,
            MagicError(
                Code.NO_PATH,
                f"free motion of stage {stage}",
                f"none found in {SEARCHES * self.settings.free_time:.1f} s",
                "a way around the obstacles",
            ),
        )

    # ------------------------------------------------------------ after the release

    def _retreat(self, request: Request, branch: Branch, task: Array) -> Array:
        """Joint path (n, J) of the open hand away from the released tool: back along its own axis, or as near to it as is clear."""
        robot, settings = self.robot, self.settings
        request.feedback("retreat", "taking the open hand away")
        self._lay(request, request.poses[-1])
        tip = request.poses[-1] @ branch.grasp.tool_from_tcp
        problem: StageError | None = None
        back = -tip[:3, 2]
        for direction in (back, transforms.unit(back + 0.5 * request.plane[:3]), transforms.unit(back - 0.5 * request.plane[:3])):
            path = self._straight(tip, settings.retreat * direction, task[-1:])[0]
            if path is None:
                problem = problem or StageError(
                    "retreat", MagicError(Code.NO_IK, "taking the open hand away", "out of reach", f"{settings.retreat} m of straight way")
                )
                continue
            hit = robot.first_collision(path, budget=request.budget, stage="retreat")
            if hit is None:
                return path
            problem = StageError(
                "retreat", MagicError(Code.PATH_IN_COLLISION, f"taking the open hand away: {hit[1]}", "in collision", "a clear way back")
            )
        assert problem is not None
        raise problem

    # ------------------------------------------------------------ timing

    def _timed(
        self,
        request: Request,
        branch: Branch,
        come: Array,
        pick: tuple[Array, Array, Array],
        carry: Array,
        task: Array,
        retreat: Array | None,
    ) -> MotionPlan:
        robot, settings = self.robot, self.settings
        velocity, acceleration, step = robot.velocity_limits, robot.acceleration_limits, settings.time_step
        track = timing.Track(robot.count)
        names: list[tuple[str, float]] = []
        try:
            track.append(timing.parameterise(come, velocity, acceleration, step, corners=True))
            track.append(timing.parameterise(pick[0], velocity * 0.6, acceleration, step))
            grasp_time = track.now
            track.hold(settings.dwell, step)
            names.append(("grasp", track.now))
            track.append(timing.parameterise(pick[2], velocity * 0.6, acceleration, step))
            track.append(timing.parameterise(carry, velocity, acceleration, step, corners=True))
            names.append(("transfer", track.now))
            began = track.now
            clock = track.follow(request.times, task, self._rests(request), velocity, acceleration, step)
        except timing.Infeasible as error:
            raise StageError(
                "timing",
                MagicError(
                    Code.TIME_PARAMETERISATION, "time parameterisation", str(error), "a path that velocity and acceleration limits allow"
                ),
            ) from error
        for phase in request.motion.phases:
            if phase.start < request.times[-1] - 1e-9:
                names.append((phase.name, began + float(clock(min(phase.end, float(request.times[-1]))))))
        release_time = None
        if retreat is not None:
            release_time = track.now
            track.hold(settings.dwell, step)
            names.append(("release", track.now))
            try:
                track.append(timing.parameterise(retreat, velocity * 0.6, acceleration, step))
            except timing.Infeasible as error:
                raise StageError(
                    "timing",
                    MagicError(
                        Code.TIME_PARAMETERISATION, "time parameterisation of the retreat", str(error), "a path that the limits allow"
                    ),
                ) from error
            names.append(("retreat", track.now))
        times, q, qd, qdd = track.arrays()
        self._check_limits(request, branch, times, q, qd, qdd, grasp_time, release_time)
        held = (times >= grasp_time) & (times <= (np.inf if release_time is None else release_time))
        poses = np.empty((len(times), 4, 4))
        poses[held] = robot.chain.forward(q[held]) @ transforms.inverse(branch.grasp.tool_from_tcp)
        poses[times < grasp_time] = request.tool.world_from_object
        if release_time is not None:
            poses[times > release_time] = poses[held][-1]
        phases = _phases(names)
        return MotionPlan(
            "arm",
            ToolMotion(times, poses, phases),
            ArmMotion(
                times, robot.chain.names, q, qd, qdd, branch.grasp.tool_from_tcp, branch.grasp.width, grasp_time, release_time, phases
            ),
        )

    def _rests(self, request: Request) -> list[int]:
        """Indices of task samples at which the tool stands still, so that its motion may be timed piece by piece."""
        last = len(request.times) - 1
        if request.strategy.mode != "plan":
            return [0, last]
        found = {0, last}
        for _, when in request.marks:
            found.add(min(last, int(np.abs(request.times - when).argmin())))
        return sorted(found)

    def _check_limits(
        self, request: Request, branch: Branch, times: Array, q: Array, qd: Array, qdd: Array, grasp_time: float, release_time: float | None
    ) -> None:
        robot = self.robot
        over = np.argwhere((q < robot.chain.lower - 1e-6) | (q > robot.chain.upper + 1e-6))
        if len(over):
            i, j = over[0]
            raise StageError(
                "timing",
                MagicError(
                    Code.JOINT_LIMIT,
                    f"{robot.chain.names[j]} at {times[i]:.2f} s",
                    round(float(q[i, j]), 4),
                    f"{robot.chain.lower[j]} to {robot.chain.upper[j]} rad",
                ),
            )
        for values, limits, unit in (
            (qd, robot.chain.velocity, "rad/s"),
            (qdd, np.array(robot.acceleration_limits) / robot.config.acceleration_scale, "rad/s^2"),
        ):
            over = np.argwhere(np.abs(values) > limits * 1.001)
            if len(over):
                i, j = over[0]
                raise StageError(
                    "timing",
                    MagicError(
                        Code.DYNAMIC_LIMIT,
                        f"{robot.chain.names[j]} at {times[i]:.2f} s",
                        f"{values[i, j]:.3f} {unit}",
                        f"up to {limits[j]:.3f} {unit}",
                    ),
                )
        some = np.unique(np.linspace(0, len(times) - 1, min(len(times), 60)).astype(int))
        held = (times[some] >= grasp_time) & (times[some] <= (np.inf if release_time is None else release_time))
        volume, centre = mass_centre(solid_pieces(request.tool))
        mass = volume * request.strategy.physics.tool_density
        for rows, load in ((some[held], mass), (some[~held], 0.0)):
            if not len(rows):
                continue
            torques = np.abs(
                robot.chain.gravity_torques(q[rows], load, transforms.apply(transforms.inverse(branch.grasp.tool_from_tcp), centre))
            )
            over = np.argwhere(torques > robot.chain.effort)
            if len(over):
                i, j = over[0]
                raise StageError(
                    "timing",
                    MagicError(
                        Code.DYNAMIC_LIMIT,
                        f"{robot.chain.names[j]} at {times[rows[i]]:.2f} s with {load:.2f} kg in hand",
                        f"{torques[i, j]:.1f} N m",
                        f"up to {robot.chain.effort[j]} N m",
                    ),
                )


class StageError(Exception):
    """A try that ended at a stage of :data:`STAGES`."""

    def __init__(self, stage: str, error: MagicError) -> None:
        super().__init__(str(error))
        self.stage = stage
        self.error = error


def _alike(a: Array, b: Array) -> bool:
    """Whether two grasps are the same to the eye: 15 mm and 20 degrees."""
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.015) and transforms.rotation_angle(a, b) < np.deg2rad(20)


def _same_place(a: Array, b: Array, closing: Array) -> bool:
    """Whether two grasps close at the same place along the same line, to 15 mm and 20 degrees, from whatever side the hand comes."""
    near = bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.015)
    return near and abs(float((a[:3, :3] @ closing) @ (b[:3, :3] @ closing))) > np.cos(np.deg2rad(20))


def _by_grasp(branches: Sequence[Branch]) -> list[list[Branch]]:
    """Branches grouped by grasp, groups and members in the given order."""
    groups: dict[int, list[Branch]] = {}
    for branch in branches:
        groups.setdefault(id(branch.grasp), []).append(branch)
    return list(groups.values())


def _phases(ends: Sequence[tuple[str, float]]) -> tuple[Phase, ...]:
    phases, start = [], 0.0
    for name, end in ends:
        if end > start + 1e-9:
            phases.append(Phase(name, start, end))
            start = end
    return tuple(phases)


def _shorten(robot: Robot, path: Array, rng: np.random.Generator, budget: Budget, stage: str, rounds: int = 25) -> Array:
    """Replace stretches of a path (n, J) by straight lines wherever those are free."""
    for _ in range(rounds):
        if len(path) < 3:
            break
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        a, b = np.sort(rng.uniform(0, lengths[-1], 2))
        if b - a < 1e-3:
            continue
        ends = np.stack([np.array([np.interp(s, lengths, path[:, j]) for j in range(path.shape[1])]) for s in (a, b)])
        if robot.first_collision(ends, step=0.08, budget=budget, stage=stage) is None:
            path = np.concatenate([path[lengths < a - 1e-9], ends, path[lengths > b + 1e-9]])
    return path
