"""Short straight moves of the hand: coming to the grasp, lifting the tool, taking the open hand away."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_planner.grasps import Grasp
from magic_planner.request import ArmSettings, Branch, Failures, Request, StageError
from magic_planner.workspace import Workspace

Array = NDArray[np.float64]
#: Ways to a grasp from which the lift is tried.
WAYS = 3


class HandMoves:
    """Plans the straight moves by tracked inverse kinematics."""

    def __init__(self, space: Workspace, settings: ArmSettings) -> None:
        self.space, self.robot, self.settings = space, space.robot, settings

    def straight(self, start: Array, shift: Array, q: Array) -> list[Array | None]:
        """Joint paths from each of q (N, J) along a straight move of the hand by ``shift`` (3,) metres, base axes; None where one
        cannot follow."""
        parts = max(2, int(np.ceil(np.linalg.norm(shift) / 0.01))) + 1
        targets = np.repeat(start[None], parts, axis=0)
        targets[:, :3, 3] += np.linspace(0, 1, parts)[:, None] * shift
        paths, stopped, _ = self.robot.chain.track(np.repeat(targets[:, None], len(q), axis=1), q, jump=self.settings.jump)
        return [paths[:, n] if stopped[n] == parts else None for n in range(len(q))]

    def reached(self, request: Request, grasps: Sequence[Grasp], failures: Failures) -> list[Grasp]:
        """Those grasps to which the hand can be brought where the tool lies, all looked at together."""
        tips = request.tool.world_from_object @ np.stack([grasp.tool_from_tcp for grasp in grasps])
        index, _ = self.robot.inverse(tips, request.start[None])
        kept = set(index.tolist())
        if len(kept) < len(grasps):
            failures.add("approach", _out_of_reach(request))
        return [grasp for n, grasp in enumerate(grasps) if n in kept]

    def pick(self, request: Request, branch: Branch) -> tuple[Array, Array, Array]:
        """Joint paths of coming to the grasp (n, J), the grasp itself (J,) and the lift (m, J)."""
        robot, settings = self.robot, self.settings
        request.feedback("lift", "picking the tool up")
        tip = request.tool.world_from_object @ branch.grasp.tool_from_tcp
        _, solutions = robot.inverse(tip[None], np.stack([branch.path[0], request.start]), seeds=16)
        if not len(solutions):
            raise StageError("approach", _out_of_reach(request))
        # The posture nearest to both neighbours costs the least motion.
        far = np.abs(solutions - branch.path[0]).max(axis=1) + np.abs(solutions - request.start).max(axis=1)
        problem: StageError | None = None
        found: list[tuple[Array, Array]] = []
        self.space.lay(request, request.tool.world_from_object)
        solutions = solutions[np.argsort(far, kind="stable")][:8]
        for share in (1.0, 0.5):
            for back, q in zip(self.straight(tip, -share * settings.standoff * tip[:3, 2], solutions), solutions, strict=True):
                request.budget.check("approach")
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
                    found.append((back[::-1], q))
                    continue
                problem = StageError(
                    "approach",
                    MagicError(Code.PATH_IN_COLLISION, f"coming to the grasp: {hit[1]}", "in collision", "a clear way to the tool"),
                )
        for back, q in self._roomiest(request, found)[:WAYS]:
            try:
                return back, q, self._lift(request, branch, tip, q)
            except StageError as error:
                problem = error
        assert problem is not None
        raise problem

    def _roomiest(self, request: Request, ways: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
        """The ways to the grasp in their order, but first those that begin with room about the tool and all that is beside it."""
        left, ordered = ways, []
        for room in (self.settings.room, self.settings.room / 3):
            self.space.come(request, room)
            kept = [not self.robot.collides(back[0]) for back, _ in left]
            ordered += [way for way, keeps in zip(left, kept, strict=True) if keeps]
            left = [way for way, keeps in zip(left, kept, strict=True) if not keeps]
        self.space.surround(request, 0.0)
        self.space.lay(request, request.tool.world_from_object)
        return ordered + left

    def raised(self, request: Request, branch: Branch) -> Array:
        """Joint path (n, J) by which a tool that is in the hand leaves what is beneath it; where it is clear, only the start (1, J)."""
        start = request.start
        self.space.hold(request, branch.grasp)
        if not self.robot.collides(start):
            return start[None]
        request.feedback("lift", "raising the tool")
        return self._lift(request, branch, self.robot.chain.forward(start[None])[0], start)

    def _lift(self, request: Request, branch: Branch, tip: Array, q: Array) -> Array:
        """Joint path (n, J) of the lift from q (J,), the hand at ``tip``; raises StageError."""
        problem: StageError | None = None
        self.space.carry_off(request, branch.grasp)
        for height in (self.settings.lift, self.settings.lift / 2):
            up = self.straight(tip, height * request.plane[:3], q[None])[0]
            if up is None:
                problem = StageError(
                    "lift",
                    MagicError(
                        Code.NO_IK, f"lifting {request.tool.id} by {height:.2f} m", "out of reach", "a lift that the arm can follow"
                    ),
                )
                continue
            hit = self.robot.first_collision(up, budget=request.budget, stage="lift")
            if hit is None:
                return up
            problem = StageError(
                "lift", MagicError(Code.PATH_IN_COLLISION, f"lifting {request.tool.id}: {hit[1]}", "in collision", "a clear lift")
            )
        assert problem is not None
        raise problem

    def retreat(self, request: Request, branch: Branch, task: Array) -> Array:
        """Joint path (n, J) of the open hand away from the released tool: back along its own axis, or as near to it as is clear.

        A tool that is let go swings to where it hangs, often after the hand, and would lean on a finger that stays within its reach:
        the hand goes the whole way where it can, else three quarters or half of it.
        """
        robot, settings = self.robot, self.settings
        request.feedback("retreat", "taking the open hand away")
        self.space.lay(request, request.poses[-1])
        tip = request.poses[-1] @ branch.grasp.tool_from_tcp
        problem: StageError | None = None
        back, up = -tip[:3, 2], 0.5 * request.plane[:3]
        directions = (back, transforms.unit(back + up), transforms.unit(back - up))
        for way, direction in itertools.product(settings.retreat * np.array([1.0, 0.75, 0.5]), directions):
            path = self.straight(tip, way * direction, task[-1:])[0]
            if path is None:
                problem = problem or StageError(
                    "retreat", MagicError(Code.NO_IK, "taking the open hand away", "out of reach", f"{way:.2f} m of straight way")
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


def _out_of_reach(request: Request) -> MagicError:
    return MagicError(Code.NO_IK, f"the grasp of {request.tool.id} where it lies", "out of reach", "a tool that the arm can reach")
