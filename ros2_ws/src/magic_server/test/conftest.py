"""Every test file of this package works in a ROS domain of its own."""

import os
import sys
from pathlib import Path

import pytest

from magic_core.domain import free_domain

# Where one test file uses another's bench.
sys.path.insert(0, str(Path(__file__).parent))

os.environ["ROS_DOMAIN_ID"] = str(free_domain(for_good=True))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Strategies: ``fake``, and ``dynamic``, which simulation cannot judge."""
    # Both read the ROS domain as they are imported.
    from magic_core import strategy as strategies
    from magic_server.testing import fakes

    root = tmp_path_factory.mktemp("strategies")
    strategies.save(fakes.strategy("fake"), root / "fake")
    strategies.save(fakes.strategy("dynamic", simulatable=False), root / "dynamic")
    return root
