"""One arm for all tests of the package: loading it takes most of a second."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def arm():
    from magic_planner.arm import ArmPlanner
    from magic_planner.robot import Robot

    planner = ArmPlanner(Robot())
    planner.warm_up()
    return planner
