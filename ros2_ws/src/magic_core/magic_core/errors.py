"""Result codes and the one exception that carries them.

Every service and action answers a numeric code and a message.  Codes come in
blocks: perception 100s, matching 200s, planning 300s, verifying 400s, execution
(the strategy server) 500s; 0 is success.  ``magic_interfaces/msg/ResultCode``
holds the same numbers for users of other languages; a test keeps the two equal.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any


class Code(IntEnum):
    """Why a request ended as it did."""

    OK = 0

    # Perception
    NO_FRAMES = 100
    NO_CAMERA_INFO = 101
    BAD_ENCODING = 102
    BAD_IMAGE = 103
    NO_DEPTH = 104
    NO_TABLE = 105
    NO_OBJECTS = 106
    STALE_DATA = 107
    BAD_INTRINSICS = 108
    NO_TRANSFORM = 109
    RECONSTRUCTION_FAILED = 110
    BAD_BAG = 111
    UNKNOWN_SEGMENTER = 112
    SEGMENTER_WEIGHTS = 113
    CAMERAS_DISAGREE = 114
    TABLE_AMBIGUOUS = 115
    ROBOT_NOT_THERE = 117
    SOMETHING_HANGS = 118
    DEPTH_UNIT = 119
    ROBOT_ELSEWHERE = 120

    # Matching
    UNKNOWN_STRATEGY = 200
    UNKNOWN_OBJECT = 201
    BAD_REQUEST_IMAGE = 202
    EMPTY_MASK = 203
    POINT_OUTSIDE = 204
    NO_MATCH = 205
    UNKNOWN_FEATURES = 206
    FEATURE_WEIGHTS = 207
    NO_CURVATURE = 208
    BAD_STRATEGY = 209
    OBJECT_CUT_OFF = 210
    AMBIGUOUS_OBJECT = 211
    HANDLE_NOT_SEEN = 212
    WAY_BLOCKED = 213

    # Planning
    BAD_MOTION = 300
    UNKNOWN_VARIANT = 301
    NO_GRASP = 302
    NO_IK = 303
    START_IN_COLLISION = 304
    PATH_IN_COLLISION = 305
    JOINT_LIMIT = 306
    DYNAMIC_LIMIT = 307
    NO_PATH = 308
    TIME_PARAMETERISATION = 309
    BAD_MESH = 310
    PLANNING_TIMEOUT = 311

    # Verifying
    PRE_CONTACT_COLLISION = 400
    LOST_CONTACT = 401
    DRIFT = 402
    UNSTABLE = 403
    GOAL_NOT_REACHED = 404
    SIMULATION_EXPLODED = 405
    SIMULATION_TIMEOUT = 406
    GRASP_SLIPPED = 407
    BAD_SCENE = 408
    LIMIT_EXCEEDED = 409
    UNKNOWN_GOAL = 410
    NOT_SURE_ENOUGH = 411
    OBSTACLE_PUSHED = 412

    # Execution
    SERVER_UNAVAILABLE = 500
    SERVER_TIMEOUT = 501
    CANCELED = 502
    NO_CANDIDATE_SUCCEEDED = 503
    BUSY = 504
    NOT_VERIFIABLE = 505
    BAD_REQUEST = 506
    EXECUTION_FAILED = 507
    GRASP_FAILED = 508
    NOT_ALONE = 509
    SCENE_CHANGED = 510
    TOOL_SLIPPED = 511
    GOAL_MISSED = 512
    GOAL_UNSEEN = 513
    ARM_NOT_AT_REST = 514
    TOOL_WEIGHT = 515
    INTERNAL = 599


#: Longer texts are cut in messages: the start tells which they are.
LONGEST = 200


class MagicError(Exception):
    """A request that cannot be served, with the code and a sentence for the caller.

    The message reads ``what: value (allowed: ...)``; ``value`` and ``allowed`` are
    left out where they are ``None``.
    """

    def __init__(self, code: Code, what: str, value: Any = None, allowed: Any = None) -> None:
        self.code = Code(code)
        message = what
        if isinstance(value, str) and len(value) > LONGEST:
            message += f": {value[:LONGEST]!r}... ({len(value)} characters)"
        elif value is not None:
            message += f": {value!r}" if isinstance(value, str) else f": {value}"
        if allowed is not None:
            if isinstance(allowed, (list, tuple, set, frozenset)):
                allowed = ", ".join(str(a) for a in allowed) or "none"
            message += f" (allowed: {allowed})"
        self.message = message
        super().__init__(f"[{int(self.code)} {self.code.name}] {message}")
