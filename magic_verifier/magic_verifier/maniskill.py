"""ManiSkill's ``PullCubeTool-v1`` by the shipped strategy ``hooking``: ``ros2 run magic_verifier maniskill``.

An arm at a table, a cube out of its reach, an L-shaped tool within it; the cube's middle has to come within 0.6 m of the arm's
base, in 100 control steps of 50 ms.  Nothing is learned for it and nothing of it is told to the strategy but how far to pull: tool
and cube become scene objects by their collision shapes, the matcher looks for the demonstrated contact on the tool, planner and
verifier work as for any other scene, and what the verifier passes is sent to the environment as joint targets.  Whether it
succeeded says the environment.

ManiSkill is not installed with the project (``requirements-maniskill.txt``) and is imported by :func:`environment` only, which leaves out
all that is to be drawn: neither a renderer nor a graphics card is needed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import Contact, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, from_trimesh
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.robot import RobotConfig
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy, find
from magic_core.views import find_view
from magic_verifier import uncertainty
from magic_verifier.rates import fewest, wilson
from magic_verifier.rollout import Limits
from magic_verifier.simulation import Settings
from magic_verifier.uncertainty import Uncertainty
from magic_verifier.verification import Proposal, verify_proposal

Array = NDArray[np.float64]
NAME = "PullCubeTool-v1"
#: What the environment calls near enough (m from the arm's base, along the table); it has no name for the number.
NEAR = 0.6
#: How much nearer the pull ends (m): a cube between the walls of a hook has some play.
BEYOND = 0.03
#: How far the cube may slide to the side in it (radii of the circle about it): the environment asks for nothing of that.
DRIFT = 1.0
#: How much of the pull may be gone before a cube that has some play is taken along (m).
PLAY = 0.01
#: The pull need not point at the arm: turns of its direction about the vertical (rad), in order of trial.  First those to which the tool,
#: as it lies, is brought soonest.
TURNS = tuple(np.deg2rad((-30.0, -15.0, -45.0, 0.0, 30.0, 15.0)))
#: The environment gives 5 s for what the strategy does in 15: its clock may go so many times faster, and of the arm's limits more is
#: used than is asked of a real one.  The fingers have closed after so many seconds.
HASTE = 6.0
ROBOT = RobotConfig(velocity_scale=1.0, acceleration_scale=0.8, jerk_scale=0.6)
CLOSING = 0.25
#: Closing, the fingers are sent so far past each other (m): what presses them is the stiffness of their drives.
PAST = 0.01
#: How far the hand comes straight to the tool, and how far it lifts it before it turns aside (m): little, for want of time, and more
#: where something stands beside the tool.
STANDOFF, LIFTS = 0.05, (0.03, 0.08)
#: How much room is kept about things (m): less than usual, as all stands where it is said to, and a way around takes time.
ROOM = 0.003
#: Of the time that is left over when the pull is done, so much (s) stays so.
SPARE = 0.15
#: No finger is so near to where the tool meets the cube (m): the cube is 40 mm wide.
AWAY = 0.045
#: So many times the grip's force is what the planner counts on: what holds is the verifier's to say, by the environment's own contacts,
#: and the planner adds up loads that do not act along one line.
GRIP_SHARE = 1.4
#: Such a further box is smaller by this on each side (m).
CORE = 0.0005
#: Of what rollouts draw, what the environment tells exactly is drawn by a little only, so that no motion passes that hangs on the last
#: digit.
WIDTHS = {"friction": 0.1, "tool_density": 0.05, "target_density": 0.05, "centre_of_mass": 0.01, "grip_force": 0.05, "stiffness": 0.05}
#: More rollouts than usual have to show that a motion succeeds: whether the tool creeps between the fingers, and how far, is chance.
#: A cube that lies against the tool is pushed a little as that is lifted, which nobody forbids.
LIMITS = Limits(required_rate=0.8, nudge=0.01)
#: A cube that is put into the tool is pushed out of it: so many control steps are waited for that.
WAIT = 3
#: Candidates of the matcher, and grasps of each, that are tried.
TOP_K, ATTEMPTS = 3, 3
#: Seconds of this process's processor for one plan.
PLANNING_TIME = 10.0


@dataclass(frozen=True)
class Episode:
    """What an environment shows after its reset, in the frame of the arm's base.

    joints (J,): the arm's, rad; step: seconds of a control step; steps: how many there are; lag: seconds by which the arm follows its
    targets, damping over stiffness of its drives.  friction, that of the fingers, and densities (kg/m^3) are those of its physics;
    grip_force (N): of each finger that presses on the tool's handle.  gains: stiffness and damping of the arm's drives, then of a
    finger's; effort: what the arm's give at most, Nm; settings: of its solver.
    """

    tool: SceneObject
    target: SceneObject
    table: Array
    joints: Array
    step: float
    steps: int
    lag: float
    friction: float
    tool_density: float
    target_density: float
    finger_friction: float
    grip_force: float
    effort: float
    gains: tuple[float, float, float, float]
    settings: Settings


def _numbers(values: Any) -> Array:
    """A tensor or array of one environment, as (n,)."""
    return np.asarray(getattr(values, "numpy", lambda: values)(), dtype=float).reshape(-1)


def _pose(pose: Any) -> Array:
    """(4, 4) of a pose of one environment: position and quaternion wxyz."""
    numbers = _numbers(pose.raw_pose)
    return transforms.from_quaternion_wxyz(numbers[:3], numbers[3:])


def _body(actor: Any, base_from_world: Array, name: str) -> tuple[SceneObject, float, float]:
    """An actor of boxes as a scene object, its density and its friction."""
    import trimesh

    (body,) = actor._bodies

    def box(shape: Any, within: float = 0.0) -> Any:
        pose = np.asarray(shape.local_pose.to_transformation_matrix())
        return trimesh.creation.box(2 * (np.asarray(shape.half_size, dtype=float) - within), pose)

    boxes = [box(shape) for shape in body.collision_shapes]
    union = boxes[0] if len(boxes) == 1 else trimesh.boolean.union(boxes, engine="manifold")
    # A scene object has one density: a box that is denser has further ones within, which nothing touches.
    least = min(float(shape.density) for shape in body.collision_shapes)
    boxes += [box(shape, CORE) for shape in body.collision_shapes for _ in range(round(float(shape.density) / least) - 1)]
    mesh, pieces = from_trimesh(union), tuple(Mesh(box.vertices, box.faces) for box in boxes)
    item = SceneObject(name, mesh, pieces, base_from_world @ _pose(actor.pose), find_view(mesh, pieces, "top"), source="known")
    friction = float(np.mean([shape.physical_material.dynamic_friction for shape in body.collision_shapes]))
    return item, float(body.mass) / sum(float(box.volume) for box in boxes), friction


def episode(env: Any, steps: int) -> Episode:
    """What an environment shows, itself without its wrappers; ``steps``: how many control steps it gives."""
    base_from_world = transforms.inverse(_pose(env.agent.robot.pose))
    tool, tool_density, friction = _body(env.l_shape_tool, base_from_world, "tool")
    target, target_density, target_friction = _body(env.cube, base_from_world, "target")
    agent, count = env.agent, len(env.agent.arm_joint_names)
    solver = env.sim_config.scene_config
    settings = Settings(
        frequency=float(env.sim_freq),
        position_iterations=int(solver.solver_position_iterations),
        velocity_iterations=int(solver.solver_velocity_iterations),
        contact_offset=float(solver.contact_offset),
        rest_offset=float(solver.rest_offset),
        angular_damping=float(env.cube._bodies[0].angular_damping),
        max_depenetration_speed=float(env.cube._bodies[0].max_depenetration_velocity),
    )
    return Episode(
        tool=tool,
        target=target,
        # It is put 5 mm above the table, which is the world's plane z = 0, and falls.
        table=np.array([0.0, 0.0, 1.0, float(base_from_world[2, 3])]),
        joints=_numbers(env.agent.robot.get_qpos())[:count],
        step=1.0 / float(env.control_freq),
        steps=steps,
        lag=float(agent.arm_damping) / float(agent.arm_stiffness),
        friction=(friction + target_friction) / 2,
        tool_density=tool_density,
        target_density=target_density,
        finger_friction=float(agent.urdf_config["_materials"]["gripper"]["dynamic_friction"]),
        grip_force=min(float(agent.gripper_force_limit), float(agent.gripper_stiffness) * (env.width / 2 + PAST)),
        effort=float(agent.arm_force_limit),
        gains=(float(agent.arm_stiffness), float(agent.arm_damping), float(agent.gripper_stiffness), float(agent.gripper_damping)),
        settings=settings,
    )


def arm_of(env: Any) -> RobotConfig:
    """The arm of an environment, itself without its wrappers: its own links and fingers, the limits of the real one."""
    urdf = Path(env.agent.urdf_path)
    return replace(ROBOT, urdf=str(urdf), srdf=str(urdf.with_suffix(".srdf")), preset="panda")


def laid(item: SceneObject, table: Array) -> SceneObject:
    """The object let down on the table, upright as it is."""
    corners = transforms.apply(item.world_from_object, item.mesh.vertices)
    pose = item.world_from_object.copy()
    pose[2, 3] -= float((corners @ table[:3] + table[3]).min()) - 1e-4
    return replace(item, world_from_object=pose)


def pull_for(middle: Array, turn: float, near: float = NEAR) -> tuple[Array, float]:
    """The direction (3,) from the arm to the target's side where the hook goes, and how far to pull against it (m).

    middle (3,): the target's, in the frame of the base.  turn (rad): of the direction about the vertical, from the one that points
    straight away from the base.  The pull ends where the middle is ``near`` metres from the base; it is infinite where none does.
    """
    away = transforms.unit([middle[0], middle[1], 0.0])
    direction = transforms.from_rotvec([0, 0, turn])[:3, :3] @ away
    # |middle - s direction| = near, along the table
    along, square = float(middle[:2] @ direction[:2]), float(middle[:2] @ middle[:2])
    root = along**2 - square + near**2
    return direction, max(0.0, along - math.sqrt(root)) if root >= 0 else math.inf


def posed(strategy: Strategy, given: Episode, turn: float) -> Strategy:
    """The strategy as this episode asks for it: direction and length of the pull, the physics; ``GOAL_NOT_REACHED`` where no pull that way
    helps."""
    middle = given.target.world_from_object[:3, 3]
    direction, least = pull_for(middle, turn)
    _, whole = pull_for(middle, turn, NEAR - BEYOND)
    if not math.isfinite(whole):
        raise MagicError(
            Code.GOAL_NOT_REACHED, f"a pull turned by {math.degrees(turn):.0f} degrees", "passes the arm by", "one that comes nearer"
        )
    goal = min(float(w.offset[0]) for w in strategy.waypoints if w.phase == "goal")
    further = np.array([-whole - goal, 0.0, 0.0])
    # The episode ends with the pull: what would come after it is left out.
    kept = (w for w in strategy.waypoints if w.phase != "retreat")
    waypoints = tuple(replace(w, offset=w.offset + further) if w.phase == "goal" else w for w in kept)
    physics = replace(
        strategy.physics,
        friction=given.friction,
        tool_density=given.tool_density,
        target_density=given.target_density,
        target_is_fixed=False,
    )
    goal_tree = strategy.goal.with_values({"distance": max(least, 0.005), "drift": DRIFT})
    return replace(strategy, target_normal=direction, waypoints=waypoints, physics=physics, goal=goal_tree)


def circle_about(item: SceneObject, strategy: Strategy) -> Any:
    """The matcher's target for one that is not round: the upright cylinder about it, met where the strategy's target normal leaves it.

    A hook has room for it however it is turned, and no side of it is in the hook before the contact.
    """
    from magic_core.rendering import canonical_view
    from magic_matcher.targets import Target

    turn = item.world_from_object[:3, :3]
    down, normal = turn.T @ strategy.target_view_direction, turn.T @ strategy.target_normal
    view = canonical_view(item.mesh, down, [0.0, 1.0, 0.0], strategy.view)
    middle = item.mesh.bounds.mean(axis=0)
    across = (item.mesh.vertices - middle) - np.outer((item.mesh.vertices - middle) @ down, down)
    radius = float(np.linalg.norm(across, axis=1).max())
    point, picture = middle + radius * normal, transforms.unit(normal @ view.object_from_view[:3, :2])
    scale = radius / strategy.target_contact.radius * strategy.target_contact.scale
    return Target(
        item.id, view, Contact(view.pixels(point), picture, radius, False, scale, contact_frame(view, view.pixels(point), picture))
    )


def hastened(motion: ToolMotion, factor: float = HASTE) -> ToolMotion:
    """The tool's motion with its clock so many times faster: an upper bound, the arm's limits say how fast it goes."""
    phases = tuple(Phase(p.name, p.start / factor, p.end / factor) for p in motion.phases)
    return ToolMotion(motion.times / factor, motion.world_from_tool, phases, tuple((name, at / factor) for name, at in motion.marks))


def actions(motion: ArmMotion, step: float, lag: float, steps: int) -> NDArray[np.float32]:
    """Joint targets (N, J + 1) for the control steps of an environment, the last column its gripper: 1 open, -1 closing.

    A drive without a target for the velocity follows ``lag`` seconds late; a target that leads by lag times the velocity takes that
    back.  Half a step more is what a target waits that is held for a step.  After its end the motion's last position is held.
    """
    count = min(steps, math.ceil((float(motion.times[-1]) + lag) / step) + 1)
    at = np.clip((np.arange(count) + 0.5) * step, 0.0, float(motion.times[-1]))
    rows = [
        np.interp(at, motion.times, motion.positions[:, j]) + lag * np.interp(at, motion.times, motion.velocities[:, j])
        for j in range(motion.positions.shape[1])
    ]
    open_again = math.inf if motion.release_time is None else motion.release_time
    grip = np.where((at >= motion.grasp_time) & (at < open_again), -1.0, 1.0)
    return np.column_stack([*rows, grip]).astype(np.float32)


def done_at(plan: MotionPlan, direction: Array, length: float) -> float:
    """Seconds of the motion after which the tool has pulled ``length`` metres against ``direction`` (3,), and what play there may be."""
    phase = next(p for p in plan.tool_motion.phases if p.name == "goal")
    times = plan.tool_motion.times
    within = (times >= phase.start - 1e-9) & (times <= phase.end + 1e-9)
    places = plan.tool_motion.world_from_tool[within, :3, 3]
    pulled = (places[0] - places) @ direction
    enough = np.flatnonzero(pulled >= length + PLAY)
    return float(times[within][enough[0]]) if len(enough) else phase.end


def unhurried(plan: MotionPlan, strategy: Strategy, given: Episode) -> tuple[MotionPlan, float]:
    """The plan with the tool carried and used as slowly as the time allows, and the seconds after which the pull is done.

    What is slower jolts the tool less in the hand.  Raises TIME_PARAMETERISATION where the pull is done too late as it is.
    """
    from magic_planner.schedule import slowed

    direction, length = strategy.target_normal, strategy.goal.numbers["distance"]
    end, whole = done_at(plan, direction, length), given.steps * given.step
    if end + given.lag > whole:
        raise MagicError(Code.TIME_PARAMETERISATION, "end of the pull", f"{end:.2f} s", f"{whole:.2f} s, all there is")
    taken = next(p.end for p in plan.tool_motion.phases if p.name == "grasp")
    plan = slowed(plan, max(1.0, (whole - given.lag - SPARE - taken) / (end - taken)))
    return plan, done_at(plan, direction, length)


class Solver:
    """Matches, plans and verifies episodes by one strategy; loads matcher and arm once."""

    def __init__(self, strategy: Strategy, arm: RobotConfig, features: str = "embedded") -> None:
        from magic_matcher.features import from_strategy, load
        from magic_matcher.matching import Matcher
        from magic_planner.arm import ArmPlanner
        from magic_planner.request import ArmSettings
        from magic_planner.robot import Robot
        from magic_verifier.articulation import described

        self.strategy = strategy
        self.matcher = Matcher(load(features, ""))
        self.reference = from_strategy(strategy)
        robot, self.arm = Robot(arm), described(arm)
        self.spreads = spreads()
        self.planners = [ArmPlanner(robot, ArmSettings(dwell=CLOSING, standoff=STANDOFF, lift=lift, room=ROOM)) for lift in LIFTS]
        self.planners[0].warm_up()

    def solve(self, given: Episode, seed: int, note: Callable[[dict[str, Any]], None]) -> MotionPlan | None:
        """The first motion that the verifier passes and that ends in time; ``note`` hears what became of each that was tried."""
        from magic_matcher.tools import tool_of
        from magic_server.pipeline import Agenda

        given = replace(given, tool=laid(given.tool, given.table), target=laid(given.target, given.table))
        candidates, simulated = None, 0
        for turn in TURNS:
            said: dict[str, Any] = {"turn": round(math.degrees(turn))}
            try:
                strategy = posed(self.strategy, given, turn)
                met = circle_about(given.target, strategy)
                if candidates is None:  # the circle is as large from every side, and the places on the tool are the same
                    found = self.matcher.match_views(
                        self.reference, strategy.tool_contact, [tool_of(given.tool, strategy.view)], met, TOP_K, False,
                        strategy.target_contact.radius,
                    )  # fmt: skip
                    candidates = found.candidates
            except MagicError as error:
                note({**said, "code": error.code.name, "message": error.message})
                continue
            agenda = Agenda([replace(c, target=met.contact) for c in candidates], strategy.reflections, ATTEMPTS)
            while (following := agenda.next()) is not None:
                promise, trial = following
                plan, code, what = self._try(strategy, given, trial, seed, simulated)
                simulated += "rollouts" in what
                note({**said, "candidate": trial.index, "reflection": trial.reflection, "attempt": trial.attempt, **what})
                if plan is not None:
                    return plan
                # What no grasp at all can follow, another attempt cannot either; there is no time to look.
                agenda.failed(promise, trial, Code.NO_GRASP if code == Code.NO_IK else code)
        return None

    def _try(
        self, strategy: Strategy, given: Episode, trial: Any, seed: int, simulated: int
    ) -> tuple[MotionPlan | None, Code, dict[str, Any]]:
        started = time.process_time()
        try:
            plan, end = unhurried(self._planned(strategy, given, trial, seed), strategy, given)
        except MagicError as error:
            return None, error.code, {"code": error.code.name, "message": error.message, "plan_seconds": time.process_time() - started}
        planned = time.process_time() - started
        proposal = Proposal(
            strategy,
            given.tool,
            given.target,
            (),
            given.table,
            plan,
            seed,
            settings=given.settings,
            spreads=self.spreads,
            limits=LIMITS,
            arm_options=hand(given),
            robot=self.arm,
        )
        verdict = verify_proposal(proposal, repetitions=fewest(LIMITS.required_rate, simulated), tried=simulated)
        what = {
            "code": verdict.code.name,
            "message": verdict.message,
            "end": end,
            "rate": verdict.success_rate,
            "rollouts": len(verdict.runs),
        }
        what |= {"plan_seconds": planned, "verify_seconds": verdict.seconds}
        return (plan if verdict.success else None), verdict.code, what

    def _planned(self, strategy: Strategy, given: Episode, trial: Any, seed: int) -> MotionPlan:
        """The arm's plan as quick as its limits let it be, with the first lift that nothing is in the way of."""
        from magic_planner.budget import Budget
        from magic_planner.giving_way import GAP_IN_HAND
        from magic_planner.grasps import GraspSettings
        from magic_planner.object_motion import plan_tool_motion
        from magic_planner.request import Problem

        scene = given.tool, given.target, trial.candidate, trial.reflection
        motion = plan_tool_motion(strategy, *scene, given.table, (), GAP_IN_HAND)
        problem = Problem(strategy, *scene, hastened(motion), given.table, start=given.joints, attempt=trial.attempt, seed=seed)
        friction = (given.finger_friction + given.friction) / 2
        grasping = GraspSettings(grip_force=GRIP_SHARE * given.grip_force, friction=friction, density=given.tool_density, away=AWAY)
        *lower, highest = self.planners
        for planner in lower:
            planner.grasping = grasping
            try:
                return planner.solve(problem, Budget(PLANNING_TIME, clock=time.process_time))
            except MagicError as error:
                if error.code != Code.PATH_IN_COLLISION:
                    raise
        highest.grasping = grasping
        return highest.solve(problem, Budget(PLANNING_TIME, clock=time.process_time))


def hand(given: Episode) -> Any:
    """The controller of the environment's arm and hand, as the verifier drives them (:class:`magic_verifier.articulation.ArmOptions`)."""
    from magic_verifier.articulation import SOFTLY, ArmOptions

    stiffness, damping, grip_stiffness, grip_damping = given.gains
    return ArmOptions(
        stiffness=(stiffness,),
        damping=(damping,),
        armature=0.0,
        grip_force=given.grip_force,
        finger_stiffness=grip_stiffness,
        closing_speed=SOFTLY / grip_damping,  # closing, so much force against the drive's damping
        finger_friction=given.finger_friction,
        finger_armature=0.0,
        past=PAST,
        command_period=given.step,
        effort=given.effort,
    )


def spreads() -> Uncertainty:
    """What rollouts draw: shapes are what the environment says, other things nearly so (:data:`WIDTHS`)."""
    shipped = uncertainty.read()
    exact = {name: replace(getattr(shipped.known, name), width=0.0) for name in ("size", "thickness", "pieces")}
    widths = {name: replace(getattr(shipped, name), width=width) for name, width in WIDTHS.items()}
    return replace(shipped, **widths, known=replace(shipped.known, **exact))


def beside(given: Episode) -> bool:
    """Whether tool and target are in each other."""
    from magic_planner.collision import Body

    return Body.from_object(given.tool).touches(Body.from_object(given.target))


@dataclass(frozen=True)
class Played:
    """What came of an episode: whether it succeeded, whether it still did when it ended, the control steps to the success (to the end,
    without), and how far the target then was from the base (m)."""

    once: bool
    at_end: bool
    steps: int
    distance: float


def still(env: Any, count: int) -> None:
    """So many control steps of an environment with the arm where it is and the hand open."""
    inner = env.unwrapped
    joints = _numbers(inner.agent.robot.get_qpos())[: len(inner.agent.arm_joint_names)]
    for _ in range(count):
        env.step(np.append(joints, 1.0).astype(np.float32))


def play(env: Any, targets: NDArray[np.float32]) -> Played:
    """Send targets (N, J + 1), then the last of them again, until the environment ends the episode by its step limit."""
    once, count, when = False, 0, 0
    while True:
        *_, truncated, info = env.step(targets[min(count, len(targets) - 1)])
        count += 1
        now = bool(_numbers(info["success"])[0])
        if now and not once:
            once, when = True, count
        if bool(_numbers(truncated)[0]):
            break
    base, cube = (_pose(pose)[:2, 3] for pose in (env.unwrapped.agent.robot.pose, env.unwrapped.cube.pose))
    return Played(once, now, when if once else count, float(np.linalg.norm(cube - base)))


def environment() -> tuple[Any, int]:
    """The environment on PhysX's CPU, with joint targets for actions and states for observations, and how many control steps it gives.

    Raises BAD_REQUEST where ManiSkill is not installed.
    """
    import logging
    import warnings

    try:
        import gymnasium
        import sapien
        import sapien.wrapper.actor_builder

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # sapien's about Vulkan, which is not used
            import mani_skill.envs  # noqa: F401  (registers the environments)
            from mani_skill.utils.building.actor_builder import ActorBuilder
            from mani_skill.utils.logging_utils import logger
            from mani_skill.utils.registration import REGISTERED_ENVS
    except ImportError as error:
        allowed = "the packages of ros2_ws/requirements-maniskill.txt, installed as it says at its top"
        raise MagicError(Code.BAD_REQUEST, "ManiSkill", f"not to be imported ({error})", allowed) from error
    logger.setLevel(logging.ERROR)
    # Nothing is drawn, and SAPIEN cannot make a material without a renderer.
    sapien.render.RenderMaterial = _Material
    for builder in (sapien.wrapper.actor_builder.ActorBuilder, ActorBuilder):
        for name in dir(builder):
            if name.startswith("add_") and "visual" in name:
                setattr(builder, name, lambda self, *_args, **_kwargs: self)
    made = gymnasium.make(
        NAME,
        obs_mode="state_dict",
        reward_mode="none",
        control_mode="pd_joint_pos",
        sim_backend="physx_cpu",
        render_backend="none",
        render_mode=None,
    )
    return made, int(REGISTERED_ENVS[NAME].max_episode_steps)


class _Material:
    """Stands for a material that nothing is drawn with."""

    def __init__(self, *_args: Any, **_kwargs: Any) -> None:
        pass

    def set_base_color(self, _color: Any) -> None:
        """Keep no colour."""


def attempt(env: Any, steps: int, solver: Solver, seed: int) -> dict[str, Any]:
    """One episode of an environment; the answer is plain data."""
    started = time.process_time()
    env.reset(seed=seed)
    given = episode(env.unwrapped, steps)
    if beside(given):
        still(env, WAIT)
        given = episode(env.unwrapped, steps - WAIT)
    tried: list[dict[str, Any]] = []
    plan = solver.solve(given, seed, tried.append)
    result: dict[str, Any] = {"seed": seed, "success": False, "verified": plan is not None, "tried": tried}
    if plan is not None:
        assert plan.arm_motion is not None
        played = play(env, actions(plan.arm_motion, given.step, given.lag, given.steps))
        result |= {"success": played.once, "at_end": played.at_end, "steps": played.steps, "distance": played.distance}
    result["seconds"] = time.process_time() - started
    return result


def summarise(results: list[dict[str, Any]]) -> str:
    """Counts, rates with their 95 % intervals, and what was in the way of those without a verified motion."""

    def rate(count: int, of: int) -> str:
        low, high = wilson(count, of)
        return f"{count} of {of} = {100 * count / max(of, 1):.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %)"

    good, verified = [r for r in results if r["success"]], [r for r in results if r["verified"]]
    lines = [f"{NAME}: {rate(len(good), len(results))} succeed", f"of the verified motions {rate(len(good), len(verified))}"]
    lines.append(f"still near when the episode ends: {rate(sum(bool(r.get('at_end')) for r in results), len(results))}")
    if good:
        steps = sorted(r["steps"] for r in good)
        lines.append(f"control steps to the success: median {steps[len(steps) // 2]}, at most {steps[-1]}")
    refused = Counter(r["tried"][-1]["code"] if r["tried"] else "none" for r in results if not r["verified"])
    if refused:
        lines.append("without a verified motion: " + ", ".join(f"{count} {code}" for code, count in refused.most_common()))
    failed = [r["seed"] for r in results if r["verified"] and not r["success"]]
    if failed:
        lines.append(f"verified, and yet no success: seeds {', '.join(map(str, failed))}")
    seconds = float(np.mean([r["seconds"] for r in results])) if results else 0.0
    return "\n".join([*lines, f"{seconds:.1f} s of the processor an episode"])


def evaluate(seeds: Iterable[int], out: Path, strategy: str = "hooking", log: Callable[[str], None] = print) -> str:
    """Play the episodes that are not stored in ``out`` yet, each as a JSON file; writes ``summary.txt`` and returns what is in it."""
    from magic_core.threads import one_thread

    env, steps = environment()
    one_thread()
    (out / "episodes").mkdir(parents=True, exist_ok=True)
    solver, results = None, []
    for seed in seeds:
        path = out / "episodes" / f"{seed}.json"
        if path.is_file():
            results.append(json.loads(path.read_text()))
            continue
        solver = solver or Solver(find(strategy), arm_of(env.unwrapped))
        result = attempt(env, steps, solver, seed)
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(result))
        temporary.replace(path)
        results.append(result)
        good = sum(bool(r["success"]) for r in results)
        how = "success" if result["success"] else "failed" if result["verified"] else f"no motion ({result['tried'][-1]['code']})"
        log(f"seed {seed}: {how}, {result['seconds']:.1f} s; {good} of {len(results)} so far")
    text = summarise(results)
    (out / "summary.txt").write_text(text + "\n")
    return text


def main(args: list[str] | None = None) -> None:
    """Entry point of ``ros2 run magic_verifier maniskill``."""
    parser = argparse.ArgumentParser(
        prog="maniskill", description=f"ManiSkill's {NAME} by the strategy hooking, verified before it is executed."
    )
    parser.add_argument("--seeds", type=int, default=500, help="how many episodes, by their seeds 0, 1, ...")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument(
        "--out", required=True, help="folder for episodes/SEED.json and summary.txt; the same command goes on where it stopped"
    )
    given = parser.parse_args(args)
    if given.seeds < 1 or given.first < 0:
        parser.error("--seeds: 1 or more; --first: 0 or more")
    try:
        print(evaluate(range(given.first, given.first + given.seeds), Path(given.out), log=lambda text: print(text, flush=True)))
    except MagicError as error:
        print(f"maniskill: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("maniskill: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
