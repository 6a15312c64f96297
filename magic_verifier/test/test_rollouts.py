"""A verdict is a set of rollouts, each a function of its draw; how many are needed; what is said of those that fail."""

import pickle
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import replace

import numpy as np
import pytest
import scenes
import yaml

from magic_core import shapes, transforms
from magic_core.errors import Code, MagicError
from magic_verifier import rates, uncertainty, verification
from magic_verifier.floating import TABLE, Body, FloatingRun, lifted_onto_table, make_setup
from magic_verifier.floating import speed as fastest
from magic_verifier.goals import Judgement, goal_test
from magic_verifier.rates import decided, fewest, passes, wilson
from magic_verifier.rollout import Limits, Task, rollout, standing
from magic_verifier.simulation import DYNAMIC, Probe, World, usable_pieces
from magic_verifier.uncertainty import ShapeError, Spread
from magic_verifier.verification import DEFAULTS, ROLLOUTS, Proposal, verify_proposal

RNG = np.random.default_rng


def verdict_of(scene, **options):
    strategy, tool, target, *obstacles, plan = scene
    proposed = {name: options.pop(name) for name in ("seed", "settings", "spreads", "limits") if name in options}
    return verify_proposal(Proposal(strategy, tool, target, tuple(obstacles), scenes.TABLE, plan, **proposed), **options)


def test_a_good_motion_is_verified_with_its_interval():
    verdict = verdict_of(scenes.hooking("L", noise=0.0))
    assert verdict.success, verdict.message
    count, passed = len(verdict.runs), sum(run.code == Code.OK for run in verdict.runs)
    assert (verdict.rate_low, verdict.rate_high) == wilson(passed, count)
    assert verdict.success_rate == passed / count
    assert 8 <= count <= ROLLOUTS and verdict.rate_low >= Limits().required_rate
    assert f"{passed} of {count} rollouts" in verdict.message
    assert len({run.metrics["pulled_distance"] for run in verdict.runs}) == count, "no two draws are the same"


def test_the_same_seed_gives_the_same_verdict_whoever_computes_it():
    scene = scenes.hooking("L", noise=0.5)
    alone = verdict_of(scene, seed=3, repetitions=6)
    together = verdict_of(scene, seed=3, repetitions=6, pool=Backwards(), workers=3)
    assert together.runs == alone.runs and together.message == alone.message
    assert verdict_of(scene, seed=4, repetitions=6).runs[1:] != alone.runs[1:]


def test_a_tool_may_stand_still_where_the_goal_leaves_it_alone():
    for scene, alone in ((scenes.scooping(), True), (scenes.hooking("L"), True), (scenes.hanging(), False)):
        strategy, tool, target, *obstacles, plan = scene
        run = FloatingRun(make_setup(tool, target, tuple(obstacles), scenes.TABLE, strategy.physics, DEFAULTS["fg"]), plan)
        assert goal_test(strategy, run, RNG(0)).leaves_alone("tool") is alone


def test_a_motion_that_fails_as_given_is_not_rolled_out():
    verdict = verdict_of(scenes.hooking("bar"))
    assert not verdict.success and len(verdict.runs) == 1
    assert verdict.failures == ("1 of 1: the tool lost the target",)


def test_others_begin_beside_the_scene_as_given_and_end_with_it():
    pool = Backwards()
    verdict = verdict_of(scenes.hooking("bar"), pool=pool, workers=2)
    assert verdict.failures == ("1 of 1: the tool lost the target",)
    # Of the three that it takes at least one was given to each of the processes, and taken back: none of it is done.
    assert len(pool.given) == 2 and all(future.cancelled() for future, _ in pool.given)


def test_steps_are_longer_where_the_tool_is_slow():
    for speed, longer in ((0.1, 4.0), (0.2, 2.0), (0.3, 1.0)):
        strategy, tool, target, _ = scenes.hooking("L")
        poses = [(transforms.make(translation=[-0.1 - 0.28 * k, 0, 0]), "goal", 0.28 / speed) for k in range(2)]
        plan = scenes.plan(poses)
        assert fastest(plan.tool_motion, Body("a", (np.eye(4, 3),), np.eye(4))) == pytest.approx(speed, rel=1e-6)
        task = verification.make_task(Proposal(strategy, tool, target, (), scenes.TABLE, plan))
        assert task.longer == longer
        assert task.under(task.drawn(1)).settings.frequency == pytest.approx(240 / longer)
    # With the settings of the arm: half of what a ball falls in a step (of 1/60 s), and of how far a fast tool comes in one (of 1/120 s).
    for speed, offset in ((0.1, 9.81 / 60**2 / 2), (0.4, 0.4 / 240)):
        strategy, tool, target, _ = scenes.hooking("L")
        poses = [(transforms.make(translation=[-0.1 - 0.28 * k, 0, 0]), "goal", 0.28 / speed) for k in range(2)]
        for thing, found in ((scenes.scooping()[2], offset), (target, 0.002)):  # a ball, and a cylinder
            task = verification.make_task(Proposal(strategy, tool, thing, (), scenes.TABLE, scenes.plan(poses), settings=DEFAULTS["arm"]))
            assert task.under(task.drawn(1)).settings.contact_offset == pytest.approx(found)
            assert task.setup.settings.contact_offset == 0.002, "the scene as given"
    # About the middle of a rod its ends at 0.1 m go by 0.1 m for each radian, in steps by their chords.
    turn = [transforms.from_rotvec([0, 0, angle]) for angle in (0.0, 1.0, 1.5)]
    plan = scenes.plan([(turn[0], "goal", 1.0), (turn[1], "goal", 2.0), (turn[2], "goal", 0.5)])
    rod = Body("rod", (np.array([[-0.1, 0, 0], [0.1, 0, 0], [0.0, 0.001, 0], [0.0, 0, 0.001]]),), np.eye(4))
    assert fastest(plan.tool_motion, rod) == pytest.approx(0.1, rel=1e-3)
    # The corners of the box of a bent tool are no points of it.
    bent = replace(rod, hulls=(*rod.hulls, rod.hulls[0][:, [1, 0, 2]]))
    assert fastest(plan.tool_motion, bent) == pytest.approx(0.1, rel=1e-3)
    assert fastest(plan.tool_motion, rod, 2.01) == pytest.approx(0.1, rel=1e-3)
    assert fastest(plan.tool_motion, rod, 0.5) == fastest(plan.tool_motion, rod)


def test_too_few_rollouts_are_not_enough_and_one_is_judged_as_given():
    scene = scenes.hooking("L", noise=0.0)
    few = verdict_of(scene, repetitions=3)
    assert (few.success, few.code) == (False, Code.NOT_SURE_ENOUGH)
    assert "70 %" in few.message
    one = verdict_of(scene, repetitions=1)
    assert one.success and len(one.runs) == 1 and one.rate_low < 0.3


def test_more_is_asked_of_a_motion_that_comes_after_others():
    scene = scenes.hooking("L", noise=0.0)
    first, fourth = (verdict_of(scene, tried=tried) for tried in (0, 3))
    assert first.success and fourth.success
    assert len(first.runs) < len(fourth.runs) and fourth.rate_low >= Limits().required_rate
    assert fourth.runs[: len(first.runs)] == first.runs, "the same draws"
    assert "rollouts passed (98.8 % interval, for 3 tried before, " in fourth.message


class Backwards(Executor):
    """Computes what it is given, the last first, when the first of it is asked for."""

    def __init__(self):
        self.given = []

    def submit(self, work, /, *args, **options):
        pool = self

        class Late(Future):
            def done(self):
                while pool.given:
                    future, call = pool.given.pop()
                    future.set_result(call())
                return super().done()

        future = Late()
        # By way of pickle, as another process gets it.
        packed = pickle.dumps((work, args, options))

        def call():
            again, its_args, its_options = pickle.loads(packed)
            return again(*its_args, **its_options)

        self.given.append((future, call))
        return future


class Keeping(Executor):
    """Is at what it is given until it is told to be done with the first of it."""

    def __init__(self):
        self.given = []

    def submit(self, work, /, *args, **options):
        self.given.append(Future())
        return self.given[-1]

    def finish(self):
        self.given.pop(0).set_result(None)


def test_the_last_that_is_left_is_not_given_to_who_is_still_at_work(monkeypatch):
    """This process would wait for it, from then on with nothing to do."""
    monkeypatch.setattr(verification._Packed, "of", classmethod(lambda cls, _task: cls(b"")))
    pool = Keeping()
    elsewhere = verification._Elsewhere(pool, 1)
    elsewhere.begin(None, 4)
    assert len(pool.given) == 2 and elsewhere.following == 3
    pool.finish()
    elsewhere.done()
    elsewhere.fill(4)
    assert len(pool.given) == 1 and elsewhere.following == 3
    elsewhere.fill(5)  # there is one more
    assert len(pool.given) == 2 and elsewhere.following == 4
    pool.finish()
    pool.finish()
    elsewhere.done()
    elsewhere.fill(5)
    assert len(pool.given) == 1 and elsewhere.following == 5


class Killed(Executor):
    """Whose process is killed with the first that it is given."""

    def submit(self, work, /, *args, **options):
        future = Future()
        future.set_exception(BrokenExecutor())
        return future


def test_what_was_lost_with_a_process_is_computed_by_this_one():
    scene = scenes.hooking("L", noise=0.5)
    assert verdict_of(scene, repetitions=4, pool=Killed(), workers=1).runs == verdict_of(scene, repetitions=4).runs


def probability(rate, most, required, z=rates.Z95):
    """How probable it is that a motion of that rate is verified, and how many rollouts that takes on average."""
    undecided, verified, looked = {1: rate}, 0.0, 1 - rate
    for count in range(2, most + 1):
        following: dict[int, float] = {}
        for passed, share in undecided.items():
            for more, chance in ((1, rate), (0, 1 - rate)):
                k, p = passed + more, share * chance
                if decided(k, count, most, required, z) or count == most:
                    verified += p * passes(k, count, required, z)
                    looked += p * count
                else:
                    following[k] = following.get(k, 0.0) + p
        undecided = following
    return verified, looked


@pytest.mark.parametrize(("rate", "verified"), [(0.5, 0.002), (0.7, 0.06), (0.9, 0.67), (0.95, 0.90), (0.98, 0.97)])
def test_how_often_a_motion_is_verified_is_what_the_documentation_says(rate, verified):
    found, looked = probability(rate, ROLLOUTS, Limits().required_rate)
    assert found == pytest.approx(verified, abs=0.008)
    assert looked < 12


def test_one_of_many_that_often_fail_is_not_verified_by_chance():
    """Of eight motions that each fail in 3 of 10 cases one is verified in two runs of five at the same level, in one of eight at their
    own."""
    required = Limits().required_rate
    alike, held = 1.0, 1.0
    for tried in range(8):
        alike *= 1 - probability(0.7, ROLLOUTS, required)[0]
        held *= 1 - probability(0.7, ROLLOUTS, required, rates.deviations(tried))[0]
    assert 1 - alike > 0.35 and 1 - held < 0.15
    # And of those that hardly ever fail any but the last is still verified.
    assert probability(0.99, ROLLOUTS, required, rates.deviations(7))[0] > 0.9
    assert rates.deviations(0) == rates.Z95 and rates.level(4) == pytest.approx(0.99)


def test_intervals():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(19, 20) == pytest.approx((0.764, 0.991), abs=1e-3)
    assert not decided(8, 8, 24, 0.7) and decided(9, 9, 24, 0.7)
    assert decided(0, 2, 24, 0.7), "two failures and nothing else: the interval is below"
    assert decided(1, 1, 3, 0.7), "three rollouts cannot show it"


@pytest.mark.parametrize(("required", "tried"), [(0.7, 0), (0.8, 0), (0.8, 3)])
def test_with_the_fewest_rollouts_one_that_fails_is_a_no(required, tried):
    most, z = fewest(required, tried), rates.deviations(tried)
    assert passes(most, most, required, z) and not passes(most - 1, most - 1, required, z)
    for done in range(1, most + 1):
        assert decided(done - 1, done, most, required, z) and not passes(done - 1, done, required, z)
    assert not decided(most - 1, most - 1, most, required, z)
    assert fewest(0.7) == 9


# ------------------------------------------------------------ what is drawn


def test_spreads_have_their_widths_and_are_cut():
    normal = Spread("normal", 0.5).draw(RNG(0), 20_000)
    assert np.abs(normal).max() <= 1.0
    assert normal.std() == pytest.approx(0.5 * 0.88, abs=0.01)  # of a normal cut at two widths
    factor = Spread("factor", 0.2).draw(RNG(0), 20_000)
    assert np.exp(-0.4) <= factor.min() and factor.max() <= np.exp(0.4) and np.median(factor) == pytest.approx(1, abs=0.01)
    uniform = Spread("uniform", 0.02).draw(RNG(0), 20_000)
    assert uniform.min() >= 0 and uniform.max() <= 0.02


def test_what_was_seen_less_is_known_less():
    found = uncertainty.read()
    _, tool, target, _ = scenes.hooking("L")
    known, camera = (found.eyes(replace(tool, source=source, confidence=1.0)) for source in ("known", "camera"))
    assert known[0].pieces.width < camera[0].pieces.width
    half = found.eyes(replace(tool, source="camera", confidence=0.5))
    assert half[1] == pytest.approx(2.0) and camera[1] == 1.0
    assert found.eyes(replace(tool, source="camera", confidence=float("nan")))[1] > half[1]
    # What perception says of the surface goes before what it says of the volume: of a thin thing's confidence nothing follows.
    stated = [found.eyes(replace(tool, source="camera", confidence=0.05, surface_error=error))[1] for error in (0.0005, 0.004, 0.008)]
    assert stated[0] == 1.0 and stated[1] == pytest.approx(0.004 / found.drawn_error) and stated[2] == pytest.approx(2 * stated[1])
    eyes = found.eyes(target)
    spread = [np.std([uncertainty.draw(found, e, eyes, 0, k).tool_error.size for k in range(200)]) for e in (camera, half)]
    assert spread[1] == pytest.approx(2 * spread[0], rel=0.01)


def test_a_shape_error_does_what_it_says():
    cube = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.004)], dtype=float)
    plain = {"amplitudes": np.zeros((3, 3)), "directions": np.eye(3), "lengths": np.ones(3), "phases": np.zeros(3)}
    body = Body("plate", (cube, cube + [0.1, 0, 0]), np.eye(4))
    thicker = ShapeError(np.zeros(3), 0.001, **plain).applied(body)
    assert np.ptp(thicker.hulls[0], axis=0) == pytest.approx([0.101, 0.101, 0.005], abs=1e-9)
    larger = ShapeError(np.array([0.002, 0, 0]), 0.0, **plain).applied(body)
    assert np.ptp(larger.corners, axis=0) == pytest.approx([0.202, 0.1, 0.004], abs=1e-9)
    waves = [
        uncertainty.draw(uncertainty.read(), (uncertainty.read().camera, 1.0), (uncertainty.read().known, 1.0), 0, k).tool_error
        for k in range(200)
    ]
    zero = [replace(w, size=np.zeros(3), thickness=0.0).applied(body).corners - body.corners for w in waves]
    assert np.std(np.concatenate(zero)) == pytest.approx(0.0009 * np.exp(0.36**2), rel=0.15), "the width of the pieces' places"


def test_one_seen_shape_is_off_by_more_than_another():
    """By how much surfaces of seen tools were off, in shares of what was stated: 0.50, 0.64 and 0.83 in the quarters, and five of six by
    less than 0.93."""
    spreads = uncertainty.read()

    def off(eyes):
        drawn = [uncertainty.draw(spreads, (eyes, 1.0), (eyes, 1.0), 0, k).tool_error for k in range(4000)]
        # Shifts of pieces that are off by as much everywhere: the root of their mean square over directions and phases.
        return np.array([np.sqrt(np.square(e.amplitudes).sum() / 2) for e in drawn]) / (eyes.pieces.width * np.sqrt(3))

    seen = off(spreads.camera)
    assert np.percentile(seen, 100 * 5 / 6) / np.percentile(seen, [25, 50, 75]) == pytest.approx(
        [0.93 / 0.50, 0.93 / 0.64, 0.93 / 0.83], rel=0.07
    )
    assert off(spreads.known) == pytest.approx(1.0)


def test_where_a_camera_saw_a_surface_it_is_known_best():
    """The back of a cup that nobody saw made the rim, which both cameras saw to a millimetre, corrugated by three: drawn fingers slipped
    off it."""
    spreads = uncertainty.read()
    strategy, tool, target, *obstacles, plan = scenes.hooking("L")
    top = tool.mesh.bounds[1, 2]
    seen = np.array([v for v in transforms.apply(tool.world_from_object, tool.mesh.vertices) if v[2] > top - 1e-3])
    middle = seen[:, 0].mean()
    off = replace(tool, source="camera", surface_error=3 * spreads.drawn_error)

    def shifts(points):
        item = replace(off, points=points, colors=np.zeros((len(points), 3), np.uint8))
        task = verification.make_task(Proposal(strategy, item, target, tuple(obstacles), scenes.TABLE, plan))
        errors = [replace(task.drawn(k).tool_error, size=np.zeros(3), thickness=0.0) for k in range(1, 150)]
        moved = [error.applied(task.setup.tool, task.shares).corners - task.setup.tool.corners for error in errors]
        return np.sqrt(np.mean(np.square(moved), axis=(0, 2))), task.setup.tool.corners

    wide, corners = shifts(np.zeros((0, 3)))
    assert wide == pytest.approx(3 * spreads.camera.pieces.width, rel=0.25)
    half = seen[seen[:, 0] < middle]
    narrow, _ = shifts(half)
    away = np.min(np.linalg.norm(corners[:, None] - transforms.apply(transforms.inverse(tool.world_from_object), half), axis=-1), axis=1)
    near, far = away < uncertainty.SEEN, away > uncertainty.UNSEEN
    assert near.any() and far.any()
    assert narrow[near] == pytest.approx(wide[near] / 3) and narrow[far] == pytest.approx(wide[far])


def test_errors_of_a_large_thing_are_no_smoother_than_those_of_a_small_one():
    """A bowl of 0.1 m is off in its shape whatever the handle's length; waves that grew with a spoon of 0.4 m displaced it as a whole."""
    spread = {}
    for length in (0.1, 0.4):
        bowl = np.array([[x, y, 0.0] for x in np.linspace(0, 0.1, 11) for y in (0, 0.05)])
        body = Body("spoon", (bowl, bowl + [length - 0.1, 0, 0]), np.eye(4))
        eyes = uncertainty.read().camera, 1.0
        errors = [uncertainty.draw(uncertainty.read(), eyes, eyes, 3, k).tool_error for k in range(150)]
        moved = [replace(e, size=np.zeros(3), thickness=0.0).applied(body).hulls[0] - bowl for e in errors]
        spread[length] = np.sqrt(np.mean([np.var(m[:, 2]) for m in moved]))
    assert spread[0.4] > 0.6 * spread[0.1] > 0.0005


def test_fixed_targets_are_displaced_and_free_ones_stay_on_the_table():
    spreads = uncertainty.read()
    for scene, fixed in ((scenes.hanging(), True), (scenes.hooking("L"), False)):
        strategy, tool, target, _ = scene
        setup = make_setup(tool, target, (), scenes.TABLE, strategy.physics, DEFAULTS["fg"])
        for k in range(20):
            drawn = uncertainty.draw(spreads, spreads.eyes(tool), spreads.eyes(target), 0, k)
            moved = uncertainty.applied(drawn, setup).target
            lowest = transforms.apply(moved.world_from_object, moved.corners)[:, 2].min()
            shift = (moved.world_from_object - setup.target.world_from_object)[:3, 3]
            assert np.linalg.norm(shift) > 0
            assert fixed or lowest == pytest.approx(0.0, abs=1e-9)
        assert not fixed or abs(shift[2]) > 0


def test_every_entry_of_the_parameter_file_gives_its_reason(tmp_path):
    def entries(found):
        return [found] if "kind" in found else [e for value in found.values() if isinstance(value, dict) for e in entries(value)]

    found = yaml.safe_load(uncertainty.FILE.read_text())
    assert len(entries(found)) == 21
    assert all(len(entry["reason"]) > 20 and entry["unit"] for entry in entries(found))
    for change, words in (
        (lambda f: f["friction"].update(kind="guess"), "friction"),
        (lambda f: f["known"]["size"].update(width="wide"), "known.size"),
        (lambda f: f.pop("lag"), "lag"),
        (lambda f: f["camera"].pop("seen_less"), "seen_less"),
        (lambda f: f["camera"].update(drawn_error=0), "drawn_error"),
    ):
        changed = yaml.safe_load(uncertainty.FILE.read_text())
        change(changed)
        path = tmp_path / "changed.yaml"
        path.write_text(yaml.safe_dump(changed))
        with pytest.raises(MagicError) as error:
            uncertainty.read(path)
        assert error.value.code == Code.BAD_REQUEST and words in error.value.message
        path.unlink()
    with pytest.raises(MagicError):
        uncertainty.read(tmp_path / "nowhere.yaml")


# ------------------------------------------------------------ why they fail


def test_the_parameter_that_separates_is_named():
    strategy, tool, target, plan = scenes.hooking("L")
    setup = make_setup(tool, target, (), scenes.TABLE, strategy.physics, DEFAULTS["fg"])
    spreads = uncertainty.read()
    eyes = spreads.eyes(tool), spreads.eyes(target)
    task = Task(strategy, setup, plan, Limits(), 0, spreads, eyes)
    friction = [None, *(task.drawn(k).values(setup)["friction"] for k in range(1, 24))]
    order = sorted(friction[1:])

    def judged(low):
        return [
            Judgement(Code.DRIFT, "the target slid off sideways: by 20 mm")
            if f is not None and f < low
            else Judgement(Code.OK, "pulled: 280 mm")
            for f in friction
        ]

    (reason,) = verification.reasons(task, judged((order[3] + order[4]) / 2))
    between = f"{(order[3] + order[4]) / 2:.3g}"
    assert reason == f"4 of 24: the target slid off sideways, at friction below {between}"
    # One failure of 24 is the outermost of some parameter more often than not: nothing is named.
    (reason,) = verification.reasons(task, judged((order[0] + order[1]) / 2))
    assert reason == "1 of 24: the target slid off sideways"


@pytest.mark.parametrize("thicker", [-0.006, 0.012])
def test_a_hand_gives_way_to_the_table_by_what_the_tool_is_thicker(thicker):
    strategy, tool, target, plan = scenes.hooking("L")
    setup = make_setup(tool, target, (), scenes.TABLE, strategy.physics, DEFAULTS["fg"])
    error = ShapeError(np.zeros(3), thicker, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), np.zeros(1))
    changed = replace(setup, tool=error.applied(setup.tool))

    def deepest(run):
        return max((i.depth for i in run.intrusions() if i.body == TABLE), default=0.0)

    planned = deepest(FloatingRun(setup, plan))
    assert deepest(FloatingRun(changed, plan, 0.0, np.eye(4), setup.tool)) <= planned + 1e-6
    lower = FloatingRun(changed, plan)
    assert thicker < 0 or deepest(lower) > planned + 0.003
    assert not lower.intrusions(harmless=0.01, planned=planned), "the table is not looked at: one that is off is raised"


@pytest.mark.parametrize("lower", [0.0, 0.02])
def test_a_path_is_looked_at_where_the_tool_may_be_deeper_than_is_harmless(lower, monkeypatch):
    """A scoop along a quarter pipe, and one that is led through it."""
    strategy, tool, target, pipe, plan = scenes.scooping()
    poses = plan.tool_motion.world_from_tool @ transforms.make(translation=[0.0, 0.0, -lower])
    plan = replace(plan, tool_motion=replace(plan.tool_motion, world_from_tool=poses))
    run = FloatingRun(make_setup(tool, target, (pipe,), scenes.TABLE, strategy.physics, DEFAULTS["fg"]), plan)
    looked, depths = [], Probe.depths
    monkeypatch.setattr(Probe, "depths", lambda probe, pose: looked.append(depths(probe, pose)) or looked[-1])
    everything, all_looks = run.intrusions(), len(looked)
    looked.clear()
    some = run.intrusions(harmless=0.01)
    assert len(looked) < (1 if lower else 0.5) * all_looks
    assert [i for i in some if i.depth > 0.01] == [i for i in everything if i.depth > 0.01]
    assert bool(lower) == any(i.depth > 0.01 and i.body != TABLE for i in some)


@pytest.mark.parametrize("off, looks", [(0.004, False), (0.012, True)])
def test_no_obstacle_is_looked_at_where_what_the_tool_is_off_by_is_too_little(off, looks, monkeypatch):
    strategy, tool, target, pipe, plan = scenes.scooping()
    setup = make_setup(tool, target, (pipe,), scenes.TABLE, strategy.physics, DEFAULTS["fg"])
    planned = max((i.depth for i in FloatingRun(setup, plan).intrusions()), default=0.0)
    low = FloatingRun(setup, plan, 0.0, transforms.make(translation=[0.0, 0.0, -off]), setup.tool)
    assert max((i.depth for i in low.intrusions()), default=0.0) <= planned + off
    looked, depths = [], Probe.depths
    monkeypatch.setattr(Probe, "depths", lambda probe, pose: looked.append(depths(probe, pose)) or looked[-1])
    low.intrusions(harmless=0.01, planned=planned)
    assert bool(looked) == looks
    looked.clear()
    low.intrusions(harmless=0.01)
    assert looked, "nothing is known of what was planned"


def test_the_others_are_told_what_the_scene_as_given_shows():
    strategy, tool, target, pipe, plan = scenes.scooping()
    task = verification.make_task(Proposal(strategy, tool, target, (pipe,), scenes.TABLE, plan))
    told = []
    first = rollout(task, 0, begin=told.append)
    assert [known.overlap for known in told] == [first.judgement.metrics["overlap"]] and task.overlap == np.inf


def test_a_drawn_tool_stands_as_it_was_seen_to_stand():
    """With an underside and a tilt that are drawn mugs topple by themselves; what is drawn of sides and top stays."""
    mug = shapes.make("mug", 3).as_object("tool", transforms.make(translation=[0.5, 0.1, 0.0]))
    mug = replace(mug, world_from_object=transforms.make(translation=[0.5, 0.1, -mug.mesh.bounds[0, 2]]))
    seen = Body("tool", tuple(usable_pieces("tool", mug.pieces)), mug.world_from_object)
    spreads = uncertainty.read()
    eyes = spreads.camera, 2.5
    moved = {"as drawn": [], "standing": []}
    for index in range(1, 7):
        drawn = uncertainty.draw(spreads, eyes, eyes, 5, index)
        shaped = drawn.tool_error.applied(seen)
        stood = standing(shaped, seen, drawn.tool_from_held, scenes.TABLE)
        np.testing.assert_allclose(stood.corners[:, :2], shaped.corners[:, :2], atol=1e-12)
        upper = seen.corners[:, 2] > 0.001
        np.testing.assert_allclose(stood.corners[upper], shaped.corners[upper], atol=1e-12)
        shift = stood.world_from_object[:3, 3] - seen.world_from_object[:3, 3]
        np.testing.assert_allclose(shift, [*drawn.tool_from_held[:2, 3], 0.0], atol=1e-12)
        for name, body in (
            ("as drawn", replace(shaped, world_from_object=seen.world_from_object @ drawn.tool_from_held)),
            ("standing", stood),
        ):
            body = lifted_onto_table(body, scenes.TABLE)
            world = World(DEFAULTS["arm"])
            world.add_table(scenes.TABLE, 0.5, "table")
            world.add("tool", list(body.hulls), body.world_from_object, DYNAMIC, 600.0, 0.5)
            for _ in range(round(0.6 * world.settings.frequency)):
                world.step()
            moved[name].append(transforms.rotation_angle(body.world_from_object, world.pose("tool")))
    assert max(moved["as drawn"]) > 0.1 and max(moved["standing"]) < 0.01
