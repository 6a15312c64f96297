"""The tables: what stands in them, that a run goes on where it stopped, and that the number of jobs changes nothing but the time."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magic_core import strategy as strategies
from magic_core.errors import MagicError
from magic_verifier import tables, tables_report
from magic_verifier.cases import Options, shown_by

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")


def cell(**more):
    return tables.Cell("I", "MAGIC", "Hooking FG", Options("hooking", "fg_no_selection", strategies=STRATEGIES), 2, 65.0, **more)


def told(result):
    """A result without its times."""
    return {key: value for key, value in result.items() if key not in ("seconds", "wall")}


def answer(options, case, film):
    good = "caliper" in case.name
    return {
        "object": case.name, "success": good, "reason": "OK" if good else "DRIFT", "candidates": [{"message": "it slid off"}],
        "simulations": 1, "impossible": "", "seconds": {"total": 0.5}, "wall": 0.6,
    }  # fmt: skip


def test_the_full_sets_have_the_papers_sizes_and_every_figure_of_it_is_there():
    every = tables.cells(strategies=STRATEGIES)
    assert {c.table for c in every} == set(tables.TABLES)
    sizes = {c.column: len(tables.cases_of(c, False)) for c in every if (c.table, c.row) == ("I", "MAGIC") and not c.control}
    assert sizes == {
        "Scooping FG": 18, "Scooping Arm": 18, "Hanging FG": 134, "Hanging Arm": 134, "Hooking No Tool Sel.": 20, "Hooking FG": 5,
        "Hooking Arm": 20, "Hanging on a rod FG": 134, "Hanging on a rod Arm": 134,
    }  # fmt: skip
    assert sum(c.paper is not None for c in every if c.table == "I") == 35
    assert [len(tables.cases_of(c, False)) for c in every if (c.table, c.row) == ("V", "MAGIC")] == [24, 24, 24]
    tree = next(c for c in every if (c.row, c.column) == ("MAGIC", "Hanging FG"))
    cases = tables.cases_of(tree, False)
    assert len({case.tools for case in cases}) == 134
    assert {case.target for case in cases} == {"mug_tree:0", "mug_tree:1", "mug_tree:2"}
    assert all(c.missing == tables.NO_WEIGHTS for c in every if c.row in ("DIFT", "SD-DINO", "DINOv2"))
    assert not any(c.missing for c in tables.cells(weights={"dinov2": "/models"}) if c.row in ("DINOv2", "w/o Feature PCA and Patch"))


def test_the_short_run_is_the_beginning_of_the_long_one():
    short, long = tables.cases_of(cell(), True), tables.cases_of(cell(), False)
    assert len(short) == 2
    assert long[:2] == short


def test_the_short_run_leaves_out_what_takes_longest():
    counts = {
        (c.row, c.column): len(tables.cases_of(c, True)) for c in tables.cells(strategies=STRATEGIES) if c.table == "I" and not c.control
    }
    assert {n for (row, column), n in counts.items() if "Arm" in column and row != "MAGIC"} == {0}
    assert {n for (row, column), n in counts.items() if "Arm" in column and row == "MAGIC"} == {tables.QUICK["arm"]}
    assert {n for (row, column), n in counts.items() if "Arm" not in column and row == "Curvature-Only"} == {1}
    assert {n for (row, column), n in counts.items() if "Arm" not in column and row == "MAGIC"} == {tables.QUICK["fg"]}


def test_it_goes_on_where_it_stopped_even_in_the_middle_of_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "attempt", answer)
    tables.run([cell()], tmp_path, True, log=lambda text: None)
    with open(tmp_path / "cases.jsonl", "a") as file:
        file.write('{"cell": "cut o')
    heard = []
    results = tables.run([cell()], tmp_path, False, log=heard.append)
    assert heard[0].startswith("20 cases, 2 done before, 18 to do")
    assert "17 left" in heard[1]
    assert len([json.loads(line) for line in (tmp_path / "cases.jsonl").read_text().splitlines()]) == 20
    (done,) = results.values()
    assert sum(r["success"] for r in done) == 5
    text = (tmp_path / "tables.txt").read_text()
    assert "65.0 %" in text
    assert "25.0 % (11 to 47; 5 of 20), 0.5 s" in text
    assert "15 DRIFT" in text
    (row,) = csv.DictReader((tmp_path / "tables.csv").read_text().splitlines())
    assert (row["successes"], row["cases"], row["paper_percent"]) == ("5", "20", "65.0")
    page = (tmp_path / "tables.html").read_text()
    assert "data:image/png" in page
    assert "it slid off" in page


def test_an_interrupted_run_shows_what_was_done(tmp_path, monkeypatch):
    asked = []

    def interrupted(options, case, film):
        asked.append(case.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return answer(options, case, film)

    monkeypatch.setattr(tables, "attempt", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tables.run([cell()], tmp_path, False, log=lambda text: None)
    assert "of 1), 0.5 s; 19 cases still to run" in (tmp_path / "tables.txt").read_text()


def test_what_geometry_forbids_is_counted_apart_and_controls_are_not():
    def result(name, success, impossible):
        return {**answer(None, type("Case", (), {"name": name}), None), "success": success, "impossible": impossible}

    results = [result("a", True, ""), result("b", False, ""), result("c", False, "too narrow"), result("d", True, "too wide")]
    found = tables_report.figure(cell(), results, 4)
    assert (found.successes, found.cases, dict(found.impossible)) == (1, 2, {"c": "too narrow", "d": "too wide"})
    assert "2 impossible, 1 of them passed" in tables_report.words(found)
    controls = tables_report.figure(cell(control=True), results, 4)
    assert tables_report.words(controls) == "2 of 4 passed (should be 0)"
    assert tables_report.words(tables_report.figure(cell(missing=tables.NO_WEIGHTS), [], 0)) == "no weights at hand"
    keto = tables_report.figure(cell(missing="the paper's figure alone"), results, 4)  # it shares its options with MAGIC
    assert (keto.cases, keto.successes, dict(keto.reasons), list(keto.failures)) == (0, 0, {}, [])


def test_results_do_not_depend_on_the_number_of_jobs(tmp_path):
    wanted = [replace(cell(), options=replace(cell().options, set="unseen"))]
    one = tables.run(wanted, tmp_path / "one", True, 1, films=False, log=lambda text: None)
    two = tables.run(wanted, tmp_path / "two", True, 2, films=False, log=lambda text: None)
    assert [told(r) for r in one[wanted[0].key]] == [told(r) for r in two[wanted[0].key]]


def test_a_mug_shows_what_a_hanger_showed():
    hanger = strategies.find("hanging", STRATEGIES)
    mug = shown_by(hanger, tables.HELD_OUT_MUG)
    assert mug.tool_contact.concave
    assert not np.array_equal(mug.tool_view.mask, hanger.tool_view.mask)
    old, new = (s.target_from_tool @ s.tool_contact.object_from_contact for s in (hanger, mug))
    np.testing.assert_allclose(new, old, atol=1e-12)
    with pytest.raises(MagicError, match="labelled region"):
        shown_by(hanger, "capital:A")


@pytest.mark.parametrize("given", [["--weights", "dinov2"], ["--weights", "vgg=/x"], ["--only", "VII"]])
def test_wrong_arguments_are_refused(given, capsys):
    with pytest.raises(SystemExit) as left:
        tables.main(given)
    assert left.value.code == 2
    assert "error" in capsys.readouterr().err
