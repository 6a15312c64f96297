"""A run as a recording for the rerun viewer, and what is said where the package is not installed."""

import sys

import pytest
from test_run_bag import record

from magic_bringup import client, rerun_recording
from magic_bringup.demo import parse


def test_without_the_package_the_extra_is_named_before_anything_runs(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert client.main(["run", "hooking", "--out", str(tmp_path), "--rerun"]) == 1
    assert "requirements-rerun.txt" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        parse(["--rerun"])
    assert ended.value.code == 2 and "requirements-rerun.txt" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("variant", ["fg", "arm"])
def test_pictures_things_and_the_motion_are_in_it(tmp_path, variant):
    pytest.importorskip("rerun")
    from rerun import dataframe

    given = record(variant)
    given.result.tool_id = "object_1"
    found = dataframe.load_recording(rerun_recording.write(given, tmp_path)).schema()
    entities = {str(column.entity_path) for column in found.component_columns()}
    assert {
        "/cameras/camera/left/color/image_raw",
        "/world/objects/object_1",
        "/world/objects/object_2",
        "/world/way",
        "/verdict",
    } <= entities
    assert ("/world/robot/panda_hand" in entities) == (variant == "arm")
    assert "motion" in {column.name for column in found.index_columns()}
