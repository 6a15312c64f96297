"""Every test file of this package works in a ROS domain of its own."""

import os
import sys
from pathlib import Path

from magic_core.domain import free_domain

# Where one test file uses another's bench.
sys.path.insert(0, str(Path(__file__).parent))

os.environ["ROS_DOMAIN_ID"] = str(free_domain(for_good=True))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
