"""What trials write: sums, and videos that open."""

import cv2
import numpy as np
import pytest

from magic_core.errors import Code
from magic_lab.trials import Seen, film, main, stage_of, summary, told


def record(name, seed, success=True, **more):
    seconds = {"perceive": 1.0, "match": 1.0, "plan": 1.0, "verify": 1.0, "execute": 2.0 + seed}
    base = {"scenario": "hooking", "object": name, "seed": seed, "success": success, "verified": True, "executed": success, "code": 0}
    base["begun"] = True
    return {**base, "reason": "", "stage": "" if success else "truth", "attempts": 1, "seconds": seconds, **more}


def test_sums_are_by_object_and_name_each_failure():
    records = [
        record("caliper", 0),
        record("caliper", 1, False, judgement="the tool lost the target"),
        record("hanger", 0, False, verified=False, begun=False, code=int(Code.NO_MATCH), stage="match", reason="nothing like it"),
        record(
            "hanger",
            1,
            False,
            begun=False,
            code=int(Code.STALE_DATA),
            stage="perceive",
            reason="verified, but the scene changed before the arm moved",
        ),
    ]
    total = summary(records)
    assert {n: (r["good"], r["of"]) for n, r in total["objects"].items()} == {"caliper": (1, 2), "hanger": (0, 2)}
    assert (total["verified_motions"]["good"], total["verified_motions"]["of"]) == (1, 2)
    assert [(f["stage"], f["code"], f["reason"]) for f in total["failures"]] == [
        ("truth", "OK", "the tool lost the target"),
        ("match", "NO_MATCH", "nothing like it"),
        ("perceive", "STALE_DATA", "verified, but the scene changed before the arm moved"),
    ]
    assert total["mean_seconds"]["execute"] == pytest.approx(2.5)
    text = told(total)
    assert "caliper: 1 of 2 succeeded" in text and "match [NO_MATCH]: nothing like it" in text
    assert told(summary([])).startswith(":")


def test_a_handle_that_no_camera_can_show_is_refused_rightly_and_told_apart():
    refused = {"begun": False, "verified": False, "code": int(Code.HANDLE_NOT_SEEN), "stage": "match"}
    records = [
        record("mug", 0),
        record("mug", 1, False, loop_in_sight=0.0, **refused),
        record("mug", 2, False, loop_in_sight=0.3, **refused),
    ]
    records.append(record("hook", 0, False, loop_in_sight=None, **refused))
    total = summary(records)
    assert (total["objects"]["mug"]["good"], total["objects"]["mug"]["of"]) == (1, 3)
    assert total["rightly_refused"] == 1
    assert (total["but_rightly_refused"]["good"], total["but_rightly_refused"]["of"]) == (1, 3)
    assert "rightly refused: 1," in told(total) and "of the others 1 of 3 succeeded" in told(total)
    assert "rightly" not in told(summary(records[:1]))


def test_where_no_candidate_succeeded_the_stage_is_how_far_the_best_got():
    code, refused = int(Code.NO_CANDIDATE_SUCCEEDED), [int(Code.NO_PATH), int(Code.GRASP_SLIPPED), int(Code.NO_IK)]
    assert stage_of(record("mug", 0, False, begun=False, code=code, refused=refused)) == "verify"
    assert stage_of(record("mug", 0, False, begun=False, code=code, refused=refused[:1])) == "plan"
    assert stage_of(record("mug", 0, False, begun=True, code=int(Code.GOAL_UNSEEN))) == "execute"


def test_the_video_opens_and_shows_every_moment(tmp_path):
    seen = Seen()
    for k in range(5):
        for camera in ("left", "right")[: 1 if k == 3 else 2]:
            image = np.full((300, 400, 3), 40 * k, np.uint8)
            seen.pictures.append((100.0 + 0.2 * k, camera, cv2.imencode(".jpg", image)[1].tobytes()))
    seen.lines.append((100.3, "plan: candidate 1"))
    files = film(seen, tmp_path, "trial")
    opened, animation = cv2.imreadanimation(str(tmp_path / files["video"]))
    assert opened and len(animation.frames) == 5
    right = [frame[100:200, 500:700, :3].mean() for frame in animation.frames]
    assert right == pytest.approx([0, 40, 80, 80, 160], abs=6), "what sends nothing is shown as it was last"
    assert cv2.imread(str(tmp_path / files["picture"])).shape == (324, 800, 3)
    assert film(Seen(), tmp_path, "nothing") == {}


def test_an_object_that_the_scenario_does_not_have_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--scenario", "hooking", "--objects", "teapot", "--out", str(tmp_path / "out")])
    assert ended.value.code == 2 and "allowed: caliper" in capsys.readouterr().err
