"""The command that times the optional networks runs, on networks of a few thousand weights."""

import subprocess
import sys
from pathlib import Path

import pytest


def test_networks_are_timed_and_compared(tmp_path):
    pytest.importorskip("transformers")
    out = tmp_path / "networks.md"
    command = [sys.executable, str(Path(__file__).with_name("networks.py")), "--tiny", "--repeat", "1", "--devices", "cpu", "cpu"]
    subprocess.run([*command, "--only", "dinov2-base", "clip-vit-base", "--out", str(out)], check=True, timeout=240)
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in out.read_text().splitlines() if row.startswith("| ")][2:]
    assert [row[0] for row in rows] == ["dinov2-base"] * 2 + ["clip-vit-base"] * 2
    # The same device twice: no difference.
    assert [row[-1] for row in rows] == ["", "0.0 px, worst 0.0", "", "logits 0.0000"]
    assert all(float(row[1]) > 0 and float(row[6].split()[0]) > 0 for row in rows)
