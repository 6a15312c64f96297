"""The table of times: what it sums up, and what it counts of processes."""

import os

import pytest

from magic_bringup.goal_times import STAGES, Run, processor_seconds, table


def stat(folder, pid, parent, user, system, name="a (strange) name"):
    (folder / str(pid)).mkdir()
    fields = ["S", str(parent), *["0"] * 9, str(user), str(system), *["0"] * 30]
    (folder / str(pid) / "stat").write_text(f"{pid} ({name}) {' '.join(fields)}\n")


def test_descendants_are_counted_and_others_are_not(tmp_path):
    tick = os.sysconf("SC_CLK_TCK")
    stat(tmp_path, 10, 1, tick, 0)
    stat(tmp_path, 11, 10, 0, 2 * tick)
    stat(tmp_path, 12, 11, 4 * tick, 0)
    stat(tmp_path, 13, 1, 8 * tick, 0)
    (tmp_path / "self").mkdir()
    assert processor_seconds(10, tmp_path) == pytest.approx(7.0)
    assert processor_seconds(11, tmp_path) == pytest.approx(6.0)


def test_this_process_has_spent_something():
    assert 0.0 < processor_seconds(os.getpid()) < 3600.0


def test_the_table_has_medians_and_names_what_did_not_end_well():
    def run(total, client, code="OK", tried=1, variant="arm", first=False):
        return Run("hooking", variant, code, tried, dict.fromkeys(STAGES, total), client, {"planner": 0.5, "verifier": 0.25}, first)

    first = [run(9.0, 9.5, first=True), run(0.8, 0.9, variant="fg", first=True)]
    rows = table([*first, run(1.0, 1.5), run(3.0, 1.0), run(2.0, 4.0, "DRIFT", 3), run(0.2, 0.3, variant="fg")]).splitlines()
    assert {row.count("|") for row in rows} == {13}
    assert rows[2] == "| hooking, arm | 9.00 | 9.00 | 3 | 2.00 | 2.00 | 2.00 | 2.00 | 1.50 | 1.00 | 0.75 | 1/3 DRIFT |"
    assert rows[3] == "| hooking, fg | 0.80 | 0.80 | 1 | 0.20 | 0.20 | 0.20 | 0.20 | 0.30 | 0.30 | 0.75 | 1 |"
