"""What a run of the demo leaves behind: the demo fills it in, the report is drawn from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Record:
    """What a run left behind, in messages."""

    summary: dict[str, Any]
    images: dict[str, Any] = field(default_factory=dict)  # topic -> sensor_msgs/Image
    scene: Any = None  # magic_interfaces/SceneObjectArray
    result: Any = None  # magic_interfaces/action/RunStrategy.Result
