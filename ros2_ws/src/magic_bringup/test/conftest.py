"""Every test file of this package works in a ROS domain of its own."""

import os

from magic_bringup.domain import free_domain

os.environ["ROS_DOMAIN_ID"] = str(free_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
