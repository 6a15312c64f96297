"""Fixed things around a task, written down as generator, seed and pose.

The ``environment`` of a strategy holds them::

    environment:
      world_from_target: {position: [x, y, z], orientation: [qx, qy, qz, qw]}   # where the demonstration's target stood
      fixtures:
        - {id: arc, family: quarter_pipe, seed: 0, parameters: {radius: 0.2},
           from_target: {position: [...], orientation: [...]}}

``from_target`` is the pose of the fixture relative to the target's contact point set
down on the table, in world axes: whatever the size of the target, its contact point
has the same place with respect to the fixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject


def pose_data(pose: NDArray[np.float64]) -> dict[str, list[float]]:
    """A pose (4, 4) as ``{position, orientation}`` (metres, quaternion xyzw), for YAML."""
    return {
        "position": [round(float(x), 9) for x in pose[:3, 3]],
        "orientation": [round(float(x), 12) for x in transforms.quaternion_xyzw(pose)],
    }


def pose_from_data(data: Mapping[str, Any]) -> NDArray[np.float64]:
    """The pose (4, 4) of ``{position, orientation}``."""
    return transforms.from_quaternion(data["position"], data["orientation"])


def demonstrated_pose(environment: Mapping[str, Any]) -> NDArray[np.float64]:
    """world_from_target (4, 4) of the demonstration that a strategy came from."""
    if "world_from_target" not in environment:
        raise MagicError(Code.BAD_STRATEGY, "environment: world_from_target", "missing", "where the target stood: position and orientation")
    try:
        return pose_from_data(environment["world_from_target"])
    except (KeyError, TypeError, ValueError) as error:
        raise MagicError(Code.BAD_STRATEGY, "environment: world_from_target", str(error), "position and orientation") from error


def fixtures(environment: Mapping[str, Any], target_contact: ArrayLike) -> list[SceneObject]:
    """The fixtures of a strategy as known objects, for a target whose contact point (3,) lies there in the world.

    Raises ``BAD_STRATEGY`` where the environment is not written as the module says.
    """
    from magic_core.shapes import make

    foot = np.asarray(target_contact, dtype=float) * [1, 1, 0]
    result = []
    for entry in environment.get("fixtures", []):
        try:
            shape = make(entry["family"], int(entry.get("seed", 0)), **entry.get("parameters", {}))
            pose = transforms.make(translation=foot) @ pose_from_data(entry["from_target"])
            result.append(shape.as_object(str(entry["id"]), pose))
        except (KeyError, TypeError, ValueError) as error:
            raise MagicError(
                Code.BAD_STRATEGY, "environment: fixtures", str(error), "id, family, from_target and, if wanted, seed and parameters"
            ) from error
    return result
