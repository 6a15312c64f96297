"""What a run leaves behind: the demo or the client fills it in, the report is drawn from it."""

from __future__ import annotations

import datetime
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magic_core.entry import version
from magic_core.errors import Code
from magic_server.pipeline import split_metrics

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
STAGES = ("perceive", "match", "plan", "verify", "total")
CAMERA_TOPIC = re.compile(r"^(?P<camera>.*/)(?P<image>color|aligned_depth_to_color)/(?P<part>image_raw|camera_info)$")


@dataclass
class Record:
    """What a run left behind, in messages; video: an animated WebP of what the cameras saw, where somebody has made one."""

    summary: dict[str, Any]
    images: dict[str, Any] = field(default_factory=dict)  # topic -> sensor_msgs/Image
    scene: Any = None  # magic_interfaces/SceneObjectArray
    result: Any = None  # magic_interfaces/action/RunStrategy.Result
    video: bytes = b""


def empty_summary(strategy: str, variant: str, features: str = "", command: str = "") -> dict[str, Any]:
    """The summary of a run that has not begun.  features: as asked for, until it is known what matched."""
    return {
        "strategy": strategy,
        "variant": variant,
        "features": features,
        "success": False,
        "code": int(Code.INTERNAL),
        "message": "the run did not begin",
        "candidates": [],
        "simulations": 0,
        "seconds": dict.fromkeys(STAGES, 0.0),
        "peak_memory_mb": {},
        "rollouts": 0,
        "success_rate": 0.0,
        "rate_interval": [0.0, 0.0],
        "failures": [],
        "notes": [],
        "executed": False,
        "date": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "version": version("magic_bringup"),
        "command": command,
    }


def take(summary: dict[str, Any], result: Any, perceive: float | None = None) -> None:
    """Fill a summary in from a RunStrategy result.

    perceive: seconds from the first images to the objects, where somebody has measured them; the server's own are its wait for
    objects that may be there already.
    """
    times = result.times
    seen = times.perceive if perceive is None else perceive
    seconds = {"perceive": seen, "match": times.match, "plan": times.plan, "verify": times.verify}
    seconds["total"] = seen + times.total - times.perceive
    summary.update(
        success=bool(result.verified and result.code == Code.OK),
        code=int(result.code),
        message=split_metrics(result.message)[0],
        features=result.features or summary["features"],
        candidates=[candidate_summary(r) for r in result.candidates],
        simulations=int(result.simulations),
        seconds={k: round(v, 3) for k, v in seconds.items()},
        rollouts=int(result.rollouts),
        success_rate=round(result.success_rate, 4),
        rate_interval=[round(result.rate_low, 4), round(result.rate_high, 4)],
        failures=list(result.failures),
        notes=list(result.notes),
        executed=bool(result.executed),
    )


def candidate_summary(report: Any) -> dict[str, Any]:
    """One CandidateReport as plain data."""
    c = report.candidate
    reason, metrics = split_metrics(report.message)
    return {
        "tool_id": c.tool_id,
        "score": round(c.score, 6),
        "s_dino": round(c.s_dino, 6),
        "s_curv": round(c.s_curv, 6),
        "rotation": round(c.rotation, 6),
        "flipped": c.flipped,
        "reflection": report.reflection,
        "stage": report.stage,
        "code": int(report.code),
        "reason": f"{Code(report.code).name}: {reason}" if reason else Code(report.code).name,
        # JSON knows no infinity.
        "metrics": {name: value if math.isfinite(value) else None for name, value in metrics.items()},
    }


def raw_topic(topic: str) -> str:
    """The name that image_transport's raw image would have."""
    return topic.removesuffix("/compressed").removesuffix("/compressedDepth")


def is_picture(topic: str) -> bool:
    """Whether a topic carries a camera's colour or registered depth, raw or compressed."""
    match = CAMERA_TOPIC.match(raw_topic(topic))
    return match is not None and match["part"] == "image_raw"


def shown(message: Any) -> Any:
    """An image message, decoded where it is a compressed one; raises BAD_IMAGE."""
    if type(message).__name__ != "CompressedImage":
        return message
    from magic_core import conversions

    if "compressedDepth" in message.format:
        return conversions.image_to_msg(conversions.depth_from_compressed_msg(message), "32FC1", message.header)
    return conversions.image_to_msg(conversions.color_from_compressed_msg(message), "rgb8", message.header)


def write_summary(record: Record, folder: Path) -> None:
    """Write ``summary.json``."""
    (folder / "summary.json").write_text(json.dumps(record.summary, indent=2, allow_nan=False) + "\n")
