"""The perception node's parameters; ``config/perception.param.yaml`` lists them with their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from magic_core import depth as depths
from magic_core import devices, transforms
from magic_core.errors import Code, MagicError
from magic_core.node import parameter, robot_parameters
from magic_core.robot import Description, RobotConfig
from magic_core.self_filter import Margins
from magic_perception.parameters import METHODS, WORKSPACE, Parameters
from magic_perception.robot_in_view import RobotInView
from magic_perception.segmenters import SEGMENTERS


@dataclass(frozen=True)
class Settings:
    """What the node is told; times in s.

    Attributes
    ----------
    cameras : their names.
    frame : of the results.
    skew : a camera's newest frame may be older than the newest of all by this.
    patience : a camera may be silent for so long.
    max_age : frames may be so old by the node's clock; 0: any.
    aligned : depth is registered to colour by the driver.
    count : frames of a camera at rest that are averaged.
    transform_timeout : the transform at an image's stamp is waited for so long.
    tolerance : the stamps of colour and depth differ by no more.
    period : between two scenes, at least.
    depth_unit : what 1 in a depth image is; empty: what its encoding says.
    segmenter, weights, device : what finds masks, and where it runs.
    algorithm : what :func:`magic_perception.pipeline.perceive` is told.
    extrinsics : world_from_camera (4, 4) of the cameras whose pose does not come from TF.
    keyframes, keyframe_age : earlier views that are kept at most, and for how long.
    workers : processes that perceive, this one among them.
    """

    cameras: tuple[str, ...]
    frame: str
    skew: float
    patience: float
    max_age: float
    aligned: bool
    count: int
    transform_timeout: float
    tolerance: float
    period: float
    depth_unit: str
    segmenter: str
    weights: str
    device: str
    algorithm: Parameters
    extrinsics: Mapping[str, NDArray[np.float64]]
    keyframes: int
    keyframe_age: float
    workers: int


def read(node: Node) -> Settings:
    """Declare and read the parameters but those of the robot.  Raises BAD_REQUEST."""
    p = partial(parameter, node)
    cameras = tuple(p("cameras", ["left", "right"], "names of the cameras, used in their topics"))
    if not cameras or len(set(cameras)) != len(cameras):
        raise MagicError(Code.BAD_REQUEST, "parameter cameras", list(cameras), "at least one name, none twice")
    depth_unit = p("depth_unit", "", "what 1 in a depth image is (mm, 0.25mm, m, ...); empty: mm in 16UC1, m in 32FC1")
    if depth_unit:
        depths.metres(depth_unit)
    return Settings(
        cameras=cameras,
        frame=p("frame", "panda_link0", "frame of the results, z up"),
        skew=p(
            "camera_tolerance",
            0.5,
            "a camera whose newest frame is older than the newest of all by more than this is left out, s",
            low=0.0,
            high=60.0,
        ),
        patience=p("camera_timeout", 2.0, "a camera silent for this long is no longer waited for, s", low=0.1, high=60.0),
        max_age=p("max_age", 0.0, "frames older than this by the node's clock are refused, s; 0: any age", low=0.0, high=3600.0),
        aligned=p("aligned", True, "depth is registered to colour by the driver"),
        count=p("average", 3, "frames of a camera at rest that are averaged", low=1, high=30),
        transform_timeout=p(
            "transform_timeout",
            1.0,
            "how long the transform at an image's stamp is waited for, s; no other pose is taken",
            low=0.0,
            high=10.0,
        ),
        tolerance=p("pairing_tolerance", 0.02, "largest difference of the stamps of colour and depth, s", low=0.0, high=1.0),
        period=1.0 / p("rate", 1.0, "scenes a second, at most", low=0.05, high=20.0),
        depth_unit=depth_unit,
        segmenter=p("segmenter", "depth", "how masks are found", choices=SEGMENTERS),
        weights=p("weights", "", "weights of the segmenter: a hub name or a local folder; empty: its default"),
        device=p("device", devices.AUTO, "torch device of the segmenter; auto: cuda where there is a GPU, else cpu"),
        algorithm=_algorithm(node),
        extrinsics={camera: pose for camera in cameras if (pose := _extrinsics(node, camera)) is not None},
        keyframes=p("keyframes", 4, "earlier views that are looked at together with the newest frames, at most; 0: none", low=0, high=16),
        workers=p("workers", 2, "processes that perceive, this one among them", low=1, high=16),
        keyframe_age=p("keyframe_age", 60.0, "an earlier view is forgotten after this, s", low=0.1, high=3600.0),
    )


def _algorithm(node: Node) -> Parameters:
    """The parameters that :func:`magic_perception.pipeline.perceive` is told."""
    p = partial(parameter, node)
    low = p("region_low", list(WORKSPACE["region_low"]), "lower corner of the workspace box, m: x and y in `frame`, z from the table found")
    high = p(
        "region_high",
        list(WORKSPACE["region_high"]),
        "upper corner of the workspace box, m: x and y in `frame`, z from the table found",
    )
    if len(low) != 3 or len(high) != 3:
        raise MagicError(Code.BAD_REQUEST, "parameters region_low, region_high", f"{list(low)}, {list(high)}", "three numbers each")
    return Parameters(
        region_low=tuple(low),
        region_high=tuple(high),
        method=p("method", "completed", "reconstruction", choices=METHODS),
        use_color=p("use_color", True, "refine masks by the colour difference to the table"),
        arm_offset=p(
            "arm_offset",
            0.015,
            "cameras that see the arm farther than this from where its joints put it are refused, and by less what they see is moved, m; 0: neither",
            low=0.0,
            high=1.0,
        ),
        split=p(
            "split",
            True,
            "part touching objects at concave seams, and at upright planes between colours, where their forms say that they are two",
        ),
        known_margin=p("known_margin", 0.012, "points this near to a known object belong to it, m", low=0.0, high=0.1),
        min_height=p("min_height", 0.004, "least height above the table that depth alone may call an object, m", low=0.001, high=0.1),
        seed=p("seed", 0, "seed of the random choices", low=0, high=2**31 - 1),
    )


def _extrinsics(node: Node, camera: str) -> NDArray[np.float64] | None:
    """world_from_camera (4, 4) of a camera as parameters give it; None: it comes from TF."""
    name = f"extrinsics.{camera}"
    text = f"pose of {camera}'s colour optical frame in `frame`: x y z qx qy qz qw; all 0: from TF"
    numbers = list(parameter(node, name, [0.0] * 7, text))
    if not any(numbers):
        return None
    if len(numbers) != 7 or not 0.9 < np.linalg.norm(numbers[3:]) < 1.1:
        raise MagicError(Code.BAD_REQUEST, f"parameter {name}", numbers, "x y z and a unit quaternion x y z w")
    return transforms.from_quaternion(numbers[:3], numbers[3:])


def read_robot(node: Node, slack: float) -> RobotInView | None:
    """Declare and read the parameters of the arm that is cut out of the pictures; ``None``: there is none to cut.  slack: by so much, s, a
    colour and a depth image of one picture may be apart.  Raises BAD_REQUEST."""
    p = partial(parameter, node)
    cuts = p("self_filter", True, "cut the robot (parameters robot.*) out of the pictures by joint_states; false where there is no arm")
    age = p("joint_state_age", 0.2, "how far a joint state may be from a picture's stamp, s", low=0.001, high=2.0)
    space = p("robot_margin", 0.01, "how much wider than its shapes the robot is cut: calibration, cables, m", low=0.0, high=0.1)
    config = robot_parameters(node)
    if not cuts:
        return None
    return RobotInView(Description(RobotConfig(**config)), Margins(space=space), age, slack)
