"""From one recorded demonstration to an arm trajectory with a tool that was never seen: learn the strategy, then use it."""

import json
from pathlib import Path

from magic_bringup import demo
from magic_verifier import learn

BAGS = Path(__file__).resolve().parents[1] / "bags"


def test_a_learned_strategy_moves_the_arm(tmp_path):
    folder = tmp_path / "pulling"
    shown = ["--bag", str(BAGS / "hooking_demonstration"), "--goal", "hook", "--value", "distance=0.2", "noise=0", "--friction", "0.3"]
    assert learn.main([*shown, "--out", str(folder)]) == 0
    used = ["--strategy", str(folder), "--variant", "arm", "--bag", str(BAGS / "hooking"), "--out", str(tmp_path / "out")]
    assert demo.main(used) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["success"], summary["message"]
    assert "could not be drawn" not in (tmp_path / "out" / "report.html").read_text()
