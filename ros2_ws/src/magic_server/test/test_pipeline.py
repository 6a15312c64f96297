"""The order of work, without ROS."""

from types import SimpleNamespace

import pytest

from magic_core.errors import Code, MagicError
from magic_server import pipeline
from magic_server.pipeline import Agenda, Matches, Planned, Progress, Request, Run, Settings, Verdict, check, reflections_of


def candidate(score=1.0, flipped=False):
    return SimpleNamespace(score=score, flipped=flipped, tool_id="tool")


class Script:
    """Stages that answer what two functions of a trial say, and note the calls; the clock moves by what each call costs."""

    def __init__(self, candidates, plan=lambda t: Code.OK, verify=lambda t: Code.OK, cost=0.0):
        self.candidates, self._plan, self._verify, self.cost = candidates, plan, verify, cost
        self.now = 0.0
        self.calls = []
        self.expected = []

    def clock(self):
        return self.now

    def perceive(self, request, timeout):
        self.now += self.cost
        return request, ""

    def match(self, request, timeout):
        self.now += self.cost
        return Matches(self.candidates, "target", "script")

    def plan(self, request, matches, trial, timeout):
        self.now += self.cost
        assert timeout > 0
        self.calls.append(("plan", trial.index, trial.reflection, trial.attempt))
        return Planned(self._plan(trial), "planned", plan=("plan", trial.index, trial.attempt))

    def expect(self, request, matches, trial, timeout):
        assert timeout > 0
        self.expected.append((trial.index, trial.reflection, trial.attempt))

    def forget(self):
        self.expected.append(None)

    def verify(self, request, matches, trial, plan, timeout):
        self.now += self.cost
        assert plan == ("plan", trial.index, trial.attempt)
        self.calls.append(("verify", trial.index, trial.reflection, trial.attempt))
        said = self._verify(trial)
        return said if isinstance(said, Verdict) else Verdict(said, "judged")


def execute(script, variant="fg", timeout=100.0, reflections=("keep", "turn"), simulatable=True, allow=False, attempts=2, **kwargs):
    request = Request("s", variant, timeout=timeout, allow_unverified=allow)
    return Run(request, reflections, simulatable, script, Settings(attempts), clock=script.clock, **kwargs).execute()


def tried(script):
    return [c[1:] for c in script.calls if c[0] == "plan"]


def test_stops_at_the_first_success():
    script = Script([candidate(), candidate(), candidate()], verify=lambda t: Code.OK if t.index == 1 else Code.DRIFT)
    outcome = execute(script)
    assert (outcome.code, outcome.verified, outcome.simulations) == (Code.OK, True, 2)
    assert outcome.plan == ("plan", 1, 0)
    assert [(r.trial.index, r.stage, r.code) for r in outcome.reports] == [(0, "verify", Code.DRIFT), (1, "verify", Code.OK)]
    assert (outcome.tool_id, outcome.target_id, outcome.features) == ("tool", "target", "script")


def passed(share):
    return Verdict(Code.OK, f"passed {share}", success_rate=share, rollouts=21)


def test_a_surer_motion_is_taken_before_one_that_passed_with_failures():
    script = Script([candidate()] * 4, verify=lambda t: passed([0.9, 0.95, 1.0, 1.0][t.index]))
    outcome = execute(script)
    assert (outcome.plan, outcome.message, outcome.verdict.success_rate) == (("plan", 2, 0), "passed 1.0", 1.0)
    assert [t[0] for t in tried(script)] == [0, 1, 2]
    # Where none is surer it is taken after all, and its report is the last.
    script = Script([candidate()] * 9, verify=lambda t: passed(0.9) if t.index in (1, 3) else Code.DRIFT)
    outcome = execute(script)
    assert (outcome.code, outcome.verified, outcome.plan, outcome.message) == (Code.OK, True, ("plan", 1, 0), "passed 0.9")
    assert [t[0] for t in tried(script)] == list(range(2 + pipeline.Choice.MORE))
    assert [r.trial.index for r in outcome.reports] == [0, 2, 3, 4, 5, 1]
    # So it is where there is nothing else to try, or the rest cannot be planned.
    assert execute(Script([candidate()], verify=lambda t: passed(0.9))).plan == ("plan", 0, 0)
    script = Script([candidate()] * 3, plan=lambda t: Code.OK if t.index == 0 else Code.NO_PATH, verify=lambda t: passed(0.9))
    assert execute(script).plan == ("plan", 0, 0)


def test_the_end_of_the_time_takes_what_has_passed_till_then():
    script = Script([candidate()] * 5, verify=lambda t: passed(0.9), cost=2.0)
    outcome = execute(script, timeout=9.0)
    assert (outcome.code, outcome.plan) == (Code.OK, ("plan", 0, 0)) and script.now <= 10.0

    def late(trial):
        if trial.index == 1:
            raise MagicError(Code.SERVER_TIMEOUT, "late")
        return passed(0.9)

    outcome = execute(Script([candidate()] * 3, verify=late))
    assert (outcome.code, outcome.plan) == (Code.OK, ("plan", 0, 0))
    assert [r.code for r in outcome.reports] == [Code.SERVER_TIMEOUT, Code.OK]

    # What makes verdicts doubtful ends the run all the same.
    def broken(trial):
        if trial.index == 1:
            raise MagicError(Code.NOT_ALONE, "two verifiers")
        return passed(0.9)

    outcome = execute(Script([candidate()] * 3, verify=broken))
    assert (outcome.code, outcome.verified, outcome.plan) == (Code.NOT_ALONE, False, None)


def test_reflections_only_for_mirrored_matches():
    script = Script([candidate(), candidate(flipped=True)], verify=lambda t: Code.GOAL_NOT_REACHED)
    outcome = execute(script)
    assert tried(script) == [(0, "keep", 0), (1, "keep", 0), (1, "turn", 0)]
    assert outcome.code == Code.NO_CANDIDATE_SUCCEEDED
    assert not outcome.verified
    assert outcome.plan is None
    assert "GOAL_NOT_REACHED" in outcome.message
    assert reflections_of(candidate(flipped=True), ("turn",)) == ("turn",)


def test_grasps_come_in_rounds_and_only_for_the_arm():
    script = Script([candidate(), candidate()], plan=lambda t: Code.NO_PATH)
    execute(script, variant="arm")
    assert tried(script) == [(0, "keep", 0), (1, "keep", 0), (0, "keep", 1), (1, "keep", 1)]
    script = Script([candidate()], plan=lambda t: Code.NO_PATH)
    execute(script, variant="fg")
    assert tried(script) == [(0, "keep", 0)]


def test_a_slipped_grasp_is_followed_by_the_next_grasp_of_the_same_contact():
    script = Script([candidate(), candidate()], verify=lambda t: Code.GRASP_SLIPPED if t.attempt == 0 else Code.DRIFT)
    execute(script, variant="arm")
    assert tried(script) == [(0, "keep", 0), (0, "keep", 1), (1, "keep", 0), (1, "keep", 1)]


@pytest.mark.parametrize("code", [Code.NO_GRASP, Code.NO_IK, Code.PATH_IN_COLLISION])
def test_no_further_attempt_where_none_can_help(code):
    script = Script([candidate()], plan=lambda t: code)
    execute(script, variant="arm", attempts=5)
    assert tried(script) == [(0, "keep", 0)]


@pytest.mark.parametrize("code", [Code.SERVER_UNAVAILABLE, Code.SERVER_TIMEOUT, Code.UNKNOWN_GOAL, Code.CANCELED])
def test_a_fatal_failure_ends_the_run_and_keeps_the_reports(code):
    def verify(trial):
        if trial.index == 1:
            raise MagicError(code, "gone")
        return Code.DRIFT

    outcome = execute(Script([candidate(), candidate(), candidate()], verify=verify))
    assert outcome.code == code
    assert [r.code for r in outcome.reports] == [Code.DRIFT, code]


def test_a_candidates_own_error_only_drops_the_candidate():
    def plan(trial):
        if trial.index == 0:
            raise ValueError("a defect")
        return Code.OK

    outcome = execute(Script([candidate(), candidate()], plan=plan))
    assert outcome.verified
    assert outcome.reports[0].code == Code.INTERNAL
    assert "a defect" in outcome.reports[0].message


def test_defects_do_not_come_out():
    script = Script([candidate()])
    script.match = lambda request, timeout: 1 / 0
    assert execute(script).code == Code.INTERNAL


def test_no_contact():
    outcome = execute(Script([]))
    assert outcome.code == Code.NO_MATCH
    assert not outcome.reports


def test_the_budget_ends_the_run():
    script = Script([candidate() for _ in range(50)], verify=lambda t: Code.DRIFT, cost=1.0)
    outcome = execute(script, timeout=7.0)
    assert outcome.code == Code.SERVER_TIMEOUT
    assert "7 s" in outcome.message
    assert script.now <= 8.0
    assert outcome.seconds["total"] == pytest.approx(script.now)


def test_stage_times_add_up():
    outcome = execute(Script([candidate(), candidate()], verify=lambda t: Code.DRIFT, cost=1.0))
    assert outcome.seconds == {"perceive": 1.0, "match": 1.0, "plan": 2.0, "verify": 2.0, "total": 6.0}


def test_cancel_between_stages():
    script = Script([candidate(), candidate()], verify=lambda t: Code.DRIFT)
    outcome = execute(script, canceled=lambda: len(script.calls) >= 2)
    assert outcome.code == Code.CANCELED
    assert len(script.calls) == 2
    assert len(outcome.reports) >= 1


def test_what_cannot_be_simulated():
    script = Script([candidate()])
    for allow, code in ((False, Code.NOT_VERIFIABLE), (True, Code.OK)):
        outcome = execute(script, simulatable=False, allow=allow)
        assert (outcome.code, outcome.verified, outcome.simulations) == (code, False, 0)
        assert outcome.plan == ("plan", 0, 0)
        assert outcome.message.startswith("not verified") and ("allow_unverified" in outcome.message) != allow


@pytest.mark.parametrize(
    "request_, code",
    [
        (Request("s", "legs"), Code.UNKNOWN_VARIANT),
        (Request("s", "fg", timeout=-1.0), Code.BAD_REQUEST),
        (Request("s", "fg", timeout=float("nan")), Code.BAD_REQUEST),
        (Request("s", "fg", tool_id="a", target_id="a"), Code.BAD_REQUEST),
        (Request("s", "fg", tool_id="a", tool_mass=-0.1), Code.BAD_REQUEST),
        (Request("s", "fg", target_mass=float("nan")), Code.BAD_REQUEST),
        (Request("s", "fg", tool_mass=0.4), Code.BAD_REQUEST),  # of which tool?
    ],
)
def test_bad_requests(request_, code):
    with pytest.raises(MagicError) as error:
        check(request_)
    assert error.value.code == code


def test_progress_names_stage_and_reasons_so_far():
    seen: list[Progress] = []
    execute(Script([candidate(), candidate()], verify=lambda t: Code.OK if t.index else Code.DRIFT), notify=seen.append)
    assert list(dict.fromkeys(p.stage for p in seen)) == ["perceive", "match", "plan", "verify"]
    last = seen[-1]
    assert (last.candidate, last.candidates) == (1, 2)
    assert [r.code for r in last.reports] == [Code.DRIFT, Code.OK]


@pytest.mark.parametrize(
    "scores, code, expected",
    [
        # Of like score: every contact first, then the second grasps.
        ((1.0, 0.9, 0.8), Code.NO_PATH, [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)]),
        # A far better contact gets its second grasp before far worse ones are tried.
        ((0.72, 0.19, 0.15), Code.LOST_CONTACT, [(0, 0), (0, 1), (1, 0), (2, 0), (1, 1), (2, 1)]),
        ((1.0, 0.9), Code.GRASP_SLIPPED, [(0, 0), (0, 1), (1, 0), (1, 1)]),
        ((0.0, -0.1), Code.DRIFT, [(0, 0), (1, 0), (0, 1), (1, 1)]),
        ((1.0, 0.9), Code.NO_GRASP, [(0, 0), (1, 0)]),
    ],
)
def test_what_promises_most_comes_next(scores, code, expected):
    agenda = Agenda([candidate(s) for s in scores], ("keep",), 2)
    order = []
    while (entry := agenda.next()) is not None:
        order.append((entry[1].index, entry[1].attempt))
        agenda.failed(*entry, code)
    assert order == expected


@pytest.mark.parametrize("variant", ["fg", "arm"])
def test_what_comes_next_is_expected_while_a_motion_is_verified(variant):
    script = Script([candidate(), candidate(0.6, flipped=True), candidate(0.5)], verify=lambda t: Code.DRIFT)
    execute(script, variant)
    *expected, end = script.expected
    assert expected == tried(script)[1:]
    assert end is None


def test_a_slipped_grasp_is_not_what_is_expected():
    script = Script([candidate(), candidate()], verify=lambda t: Code.GRASP_SLIPPED if t.attempt == 0 else Code.OK)
    execute(script, "arm")
    assert tried(script) == [(0, "keep", 0), (0, "keep", 1)]
    assert script.expected == [(1, "keep", 0), (1, "keep", 0), None]


def test_nothing_is_expected_where_nothing_follows():
    script = Script([candidate()])
    execute(script)
    assert script.expected == [None]
    script = Script([candidate(), candidate()])
    execute(script, simulatable=False, allow=True)
    assert script.expected == [None]
    script = Script([candidate(), candidate()], cost=1.0)
    execute(script, timeout=3.1)  # over before the motion is verified
    assert script.expected == [None]


def test_to_look_ahead_changes_nothing():
    looked, plain = (Agenda([candidate(1.0), candidate(0.7), candidate(0.4)], ("keep",), 3) for _ in range(2))
    while (entry := looked.next()) is not None:
        assert entry == plain.next()
        for _ in range(2):
            following = looked.foreseen(*entry)
        for agenda in (looked, plain):
            agenda.failed(*entry, Code.NO_PATH)
        assert following == (looked._heap[0][-1] if looked._heap else None)
    assert plain.next() is None


def test_what_was_tried_before_is_left_out():
    tried = {0: 2, 1: 1, 2: 0}
    candidates = [candidate(1.0), candidate(0.9), candidate(0.8)]
    agenda = Agenda(candidates, ("keep",), 2, lambda c: tried[candidates.index(c)])
    order = []
    while (entry := agenda.next()) is not None:
        order.append((entry[1].index, entry[1].attempt))
        agenda.failed(*entry, Code.NO_PATH)
    assert order == [(1, 1), (2, 0), (2, 1)]
    outcome = execute(Script([candidate()]), spent=lambda c: 9)
    assert (outcome.code, outcome.message) == (Code.NO_CANDIDATE_SUCCEEDED, "each of 1 candidates has been tried before")


def test_runs_of_one_goal_are_told_together():
    failed = execute(Script([candidate()], verify=lambda t: Code.DRIFT, cost=1.0))
    passed = execute(Script([candidate()], cost=1.0))
    both = pipeline.joined([failed, passed], passed)
    assert (both.code, both.plan, both.simulations) == (Code.OK, passed.plan, 2)
    assert [r.code for r in both.reports] == [Code.DRIFT, Code.OK]
    assert both.seconds == {"perceive": 2.0, "match": 2.0, "plan": 2.0, "verify": 2.0, "total": 8.0}


def test_agenda_is_empty_in_the_end():
    agenda = Agenda([candidate()], ("keep",), 1)
    turn, trial = agenda.next()
    agenda.failed(turn, trial, Code.NO_PATH)
    assert agenda.next() is None


@pytest.mark.parametrize(
    "sentence, metrics",
    [
        ("pulled 286 mm", [("pulled_distance", 0.2863), ("final_speed", 2.889e-05)]),
        ("the tool hit the target: '10.0 N' (allowed: less than 5 N)", [("overlap", 0.0), ("grip_width", float("inf"))]),
        ("objects holds 1 objects ['rod'] (allowed: two)", []),
        ("one of ['fg', 'arm']", []),
    ],
)
def test_measurements_are_told_apart_from_the_sentence(sentence, metrics):
    assert pipeline.split_metrics(pipeline.with_metrics(sentence, metrics)) == (sentence, dict(metrics))
