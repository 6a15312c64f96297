"""Makes the tests' own helpers importable, in a ROS domain of their own."""

import os
import sys
from pathlib import Path

from magic_core.domain import free_domain

sys.path.insert(0, str(Path(__file__).parent))

os.environ["ROS_DOMAIN_ID"] = str(free_domain(for_good=True))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
