"""The demo as a user runs it: exit status, summary and report."""

# In a file of its own: a graph that a module's fixture still holds would share its ROS context.

import json
import signal
from pathlib import Path

from magic_bringup import demo

BAGS = Path(__file__).resolve().parents[1] / "bags"


def test_demo_writes_summary_and_report(tmp_path):
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    assert demo.main(["--strategy", "hooking", "--variant", "fg", "--bag", str(BAGS / "hooking"), "--out", str(tmp_path)]) == 0
    assert [signal.getsignal(number) for number in numbers] == before  # else what the caller starts next ignores Ctrl-C
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == [
        "strategy",
        "variant",
        "features",
        "success",
        "code",
        "message",
        "candidates",
        "simulations",
        "seconds",
        "peak_memory_mb",
        "rollouts",
        "success_rate",
        "rate_interval",
        "failures",
        "notes",
        "executed",
        "date",
        "version",
        "command",
    ]
    assert (summary["success"], summary["code"], summary["features"]) == (True, 0, "embedded")
    assert list(summary["seconds"]) == ["perceive", "match", "plan", "verify", "total"]
    assert summary["seconds"]["perceive"] > 0.05  # no scene is seen in less
    assert sum(summary["seconds"][s] for s in ("perceive", "match", "plan", "verify")) <= summary["seconds"]["total"] + 0.01
    assert set(summary["peak_memory_mb"]) >= {"perception", "matcher", "planner", "verifier", "strategy_server"}
    page = (tmp_path / "report.html").read_text()
    assert "could not be drawn" not in page
    assert page.count("data:image/") > 10
