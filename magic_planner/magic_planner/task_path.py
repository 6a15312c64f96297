"""The arm along the task: from the grasps to joint paths that follow the tool's motion, clear of everything."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_planner.grasps import Grasp
from magic_planner.object_motion import turning
from magic_planner.request import ArmSettings, Branch, Failures, Request, StageError
from magic_planner.robot import Collision, coarse_to_fine
from magic_planner.workspace import Workspace

Array = NDArray[np.float64]


def key_poses(poses: Array, settings: ArmSettings) -> NDArray[np.int64]:
    """Indices of task poses at most key_length and key_angle apart, the first and last among them."""
    keys = [0]
    while keys[-1] < len(poses) - 1:
        rest = poses[keys[-1] + 1 : keys[-1] + 65]
        far = np.linalg.norm(rest[:, :3, 3] - poses[keys[-1], :3, 3], axis=1) > settings.key_length
        far |= turning(poses[keys[-1]], rest) > settings.key_angle
        keys.append(keys[-1] + (max(1, int(far.argmax())) if far.any() else len(rest)))
    return np.array(keys)


class TaskPath:
    """Finds, tests and refines the joint paths of the task."""

    def __init__(self, space: Workspace, settings: ArmSettings) -> None:
        self.space, self.robot, self.settings = space, space.robot, settings

    def branches(self, request: Request, grasps: Sequence[Grasp], failures: Failures) -> list[Branch]:
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

    def clear(self, request: Request, branches: Sequence[Branch], failures: Failures) -> Iterator[tuple[Grasp, Iterator[Branch]]]:
        """The grasps of branches whose arm, seen without the tool, is clear of everything at every key pose, and for each its branches.

        Both come in the order of the branches, and are looked at only when they are asked for.
        """
        orders = self._orders(request)

        def free(branch: Branch) -> bool:
            key = self._met_key(request, branch, orders)
            if key is not None:
                failures.add("task", lambda: self._collision(request, key, self.robot.collision(branch.path[key])))
            return key is None

        seen: set[int] = set()
        for n, branch in enumerate(branches):
            if n % 8 == 0:
                request.budget.check("task")
            if id(branch.grasp) in seen or not free(branch):
                continue
            seen.add(id(branch.grasp))
            others = (other for other in branches[n + 1 :] if other.grasp is branch.grasp and free(other))
            yield branch.grasp, itertools.chain([branch], others)

    def _orders(self, request: Request) -> list[tuple[bool, list[int]]]:
        """The key poses before the tool meets a target that goes along with it, and those after (True), each from coarse to fine."""
        after = request.times[request.keys] > request.met + 1e-9
        if request.strategy.physics.target_is_fixed:
            after[:] = False
        return [(moved, coarse_to_fine(np.flatnonzero(after == moved))) for moved in (False, True)]

    def _met_key(self, request: Request, branch: Branch, orders: list[tuple[bool, list[int]]]) -> int | None:
        """A key pose at which the arm without the tool meets something; it goes to the front of its order, and that before the other
        one, for where one branch fails others fail too."""
        self.space.empty(request)
        for which, (moved, order) in enumerate(orders):
            self.space.ignore_target(request, moved)
            for place, key in enumerate(order):
                if self.robot.collides(branch.path[key]):
                    order.insert(0, order.pop(place))
                    orders.insert(0, orders.pop(which))
                    return key
        self.space.ignore_target(request, False)
        return None

    def _collision(self, request: Request, key: int, pair: Collision | None) -> MagicError:
        return MagicError(
            Code.PATH_IN_COLLISION, f"{request.place(int(request.keys[key]))}: {pair}", "in collision", "a task path clear of the arm"
        )

    def check(self, request: Request, branch: Branch) -> None:
        """Raise StageError where the arm, or what it holds, meets something at a key pose or between them."""
        robot = self.robot
        self.space.hold(request, branch.grasp)
        # The tool's own contacts are the task; physics judges them.  The arm's are not allowed.
        robot.allow(request.tool.id, "table", *request.surroundings())
        met = int(np.searchsorted(request.times[request.keys], request.met + 1e-9))
        fixed = request.strategy.physics.target_is_fixed
        before = len(branch.path) if fixed else max(1, met)
        hit = robot.first_collision(branch.path[:before], budget=request.budget, stage="task")
        if hit is None and before < len(branch.path):
            self.space.ignore_target(request, True)
            hit = robot.first_collision(branch.path[before - 1 :], budget=request.budget, stage="task")
            hit = None if hit is None else (hit[0] + before - 1, hit[1])
        if hit is not None:
            raise StageError("task", self._collision(request, *hit))

    def follow(self, request: Request, branch: Branch) -> Array:
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
