"""Free motions of the Panda by roboplan, for :mod:`magic_planner.alternatives`: run by the Python of an environment that has it.

Imports nothing of this project, whose environment cannot have roboplan: it asks for another numpy than MPlib.
``python free_by_roboplan.py IN.npz OUT.npz``: boxes and pairs of joint positions in, paths and seconds of the processor out.
"""

from __future__ import annotations

import itertools
import sys
import time
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

#: Of the search, as its parameters are named: s at most, rad between checked states and of one connection.
SECONDS, CHECKED, CONNECTED = 8.0, 0.05, 0.9
GROUP = "arm"


def scene_of(given: Any) -> Any:
    """The Panda, its fingers open, among the boxes."""
    core = import_module("roboplan.core")
    urdf, srdf = Path(str(given["urdf"])), Path(str(given["srdf"]))
    found = core.Scene("boxes", core.loadUrdfSceneDescription(str(urdf), [str(given["packages"])]))
    found.allowAdjacentLinkCollisions()
    for pair in ElementTree.parse(srdf).getroot().findall("disable_collisions"):
        found.setCollisions(pair.get("link1"), pair.get("link2"), False)
    found.addGroupFromChain(GROUP, str(given["base"]), str(given["tip"]))
    positions = np.array(found.getCurrentJointPositions())
    positions[len(given["names"]) :] = float(given["finger"])
    found.setJointPositions(positions)
    names = [f"box_{i}" for i in range(len(given["sizes"]))]
    for name, size, pose in zip(names, given["sizes"], given["poses"]):
        found.addBoxGeometry(name, "universe", core.Box(*map(float, size)), np.asfortranarray(pose), np.array([1.0, 0.0, 0.0, 1.0]))
    for first, second in itertools.combinations(names, 2):
        found.setCollisions(first, second, False)
    return found


def main() -> None:
    """Plan every pair."""
    core, rrt = import_module("roboplan.core"), import_module("roboplan.rrt")
    given = np.load(sys.argv[1])
    options = rrt.RRTOptions()
    options.rrt_connect, options.max_planning_time, options.group_name = True, SECONDS, GROUP
    options.collision_check_step_size, options.max_connection_distance = CHECKED, CONNECTED
    planner = rrt.RRT(scene_of(given), options)

    def configuration(positions: Any) -> Any:
        made = core.JointConfiguration()
        made.joint_names, made.positions = [str(name) for name in given["names"]], positions
        return made

    paths, seconds = [], []
    for index, (start, goal) in enumerate(given["pairs"]):
        planner.setRngSeed(index + 1)
        began = time.process_time()
        try:
            path = planner.plan(configuration(start), configuration(goal))
        except RuntimeError:
            path = None
        seconds.append(time.process_time() - began)
        paths.append(None if path is None else np.array([np.asarray(q) for q in path.positions]))
    np.savez(sys.argv[2], paths=np.array(paths, dtype=object), seconds=seconds)


if __name__ == "__main__":
    main()
