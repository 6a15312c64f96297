"""Makes the tests' own helpers importable, and gives all tests one arm: loading it takes most of a second."""

import importlib
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

# pytest's importlib mode names tests after their folders and so takes magic_planner/, the
# folder, for magic_planner, the package in it.  Give the name back.
_shadow = sys.modules.get("magic_planner")
if _shadow is not None and getattr(_shadow, "__file__", None) is None:
    del sys.modules["magic_planner"]
    importlib.import_module("magic_planner")


@pytest.fixture(scope="session")
def arm():
    """The Panda, ready to plan."""
    from magic_planner.arm import ArmPlanner
    from magic_planner.request import ArmSettings
    from magic_planner.robot import Robot

    # The same paths are found on a machine that has other things to do.
    planner = ArmPlanner(Robot(), ArmSettings(free_time=3.0))
    planner.warm_up()
    return planner
