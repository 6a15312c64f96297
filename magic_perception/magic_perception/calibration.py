"""Where cameras stand, from pictures of a ChArUco board.

The board lies at a place that is known in the world (the robot's base frame), or it is fixed to the hand and carried before the cameras;
then where the hand was is known of each picture, and where the board sits on the hand is found along with the cameras.  All cameras are
found together, by least squares over the corners' pixels:

    min  sum |project(K_c, D_c, camera_c_from_world  world_from_board_s  X_i) - u_csi|^2,      world_from_board_s = world_from_hand_s
    hand_from_board

with a loss that grows linearly beyond a pixel.  From the same equations follows how far off a point of the workspace may be; what is not
sure enough, fits too badly or contradicts the measured depth is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError

#: A view with fewer corners than this says too little, and one whose corners lie in a narrower strip than this, pixels.
CORNERS, STRIP = 8, 20.0
#: Shots with the board on the hand, at least; and by how much its turns have to differ about a second axis, rad.
SHOTS, SECOND_AXIS = 6, np.radians(8.0)
#: The largest rms residual of a camera, pixels, and what is taken for the detector's own error where residuals are less.
RESIDUAL, DETECTOR = 1.0, 0.1
#: How far (two standard deviations) a point of the workspace may be off, m.
ALLOWED = 0.005
#: By how much the board's distance by depth may differ from that by its size.
SCALE = 0.03
#: A board's two poses that explain a picture equally well: the worse residual has to be larger by this factor, or by so many pixels.
AMBIGUOUS, APART = 2.0, 0.5
#: Points of the workspace (x, y, z), metres, by which accuracy is told: the default region of perception.
WORKSPACE = np.array([[x, y, z] for x in (0.15, 0.55, 0.95) for y in (-0.6, 0.0, 0.6) for z in (0.0, 0.3)])
DICTIONARIES = tuple(f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000))


@dataclass(frozen=True)
class Board:
    """A ChArUco board: squares in x and y, their edge and that of the markers in metres, the dictionary of the markers; legacy: drawn by
    OpenCV before 4.6, where boards of an even number of rows begin with a marker.

    Its frame has the origin at the outer corner of the first square, x along the columns, y along the rows, z into the board.
    """

    columns: int = 7
    rows: int = 5
    square: float = 0.04
    marker: float = 0.03
    dictionary: str = "5X5_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise MagicError(Code.BAD_REQUEST, "squares of the board", (self.columns, self.rows), "at least 3 x 3")
        if not 0 < self.marker < self.square < 1:
            raise MagicError(Code.BAD_REQUEST, "edges of marker and square", (self.marker, self.square), "0 < marker < square < 1 m")
        if self.dictionary not in DICTIONARIES:
            raise MagicError(Code.BAD_REQUEST, "dictionary", self.dictionary, DICTIONARIES)
        if self.columns * self.rows // 2 > int(self.dictionary.partition("_")[2]):
            raise MagicError(
                Code.BAD_REQUEST, f"markers of dictionary {self.dictionary}", self.columns * self.rows // 2, "no more than it has"
            )

    def _made(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def corners(self) -> NDArray[np.float64]:
        """The inner corners (M, 3) in the board's frame, metres; their place in the list is their id."""
        return np.asarray(self._made().getChessboardCorners(), dtype=float)

    def drawn(self, per_square: int = 200, margin: int = 0) -> NDArray[np.uint8]:
        """The board as a picture (H, W) uint8, ``per_square`` pixels a square, with a white margin in pixels."""
        size = (self.columns * per_square + 2 * margin, self.rows * per_square + 2 * margin)
        return np.asarray(self._made().generateImage(size, marginSize=margin))

    def detected(self, color: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids (N,) and pixels (N, 2) of the corners in a picture (H, W, 3) RGB; empty where there are too few."""
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(self._made()).detectBoard(gray)
        if ids is None or len(ids) < CORNERS:
            return np.empty(0, dtype=np.int64), np.empty((0, 2))
        found = np.asarray(pixels, dtype=np.float32).reshape(-1, 1, 2)
        # OpenCV 4.11's corners of ChArUco boards lie half a pixel to the right and below; refined once more they are exact.
        # The window stays off the markers in the white squares.
        apart = np.sort(np.linalg.norm(found - found.reshape(1, -1, 2), axis=2), axis=1)[:, 1]
        half = int(np.clip((1 - self.marker / self.square) / 2 * np.median(apart), 2, 7))
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        found = cv2.cornerSubPix(gray, found, (half, half), (-1, -1), end).reshape(-1, 2).astype(float)
        if np.linalg.svd(found - found.mean(axis=0), compute_uv=False)[1] < STRIP / 4 * np.sqrt(len(found)):
            return np.empty(0, dtype=np.int64), np.empty((0, 2))
        return ids.reshape(-1).astype(np.int64), found


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera with its distortion coefficients (0, 4, 5 or 8, OpenCV's order)."""

    intrinsics: Intrinsics
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the optical frame to pixels (N, 2)."""
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.intrinsics.matrix, self._coefficients)
        return pixels.reshape(-1, 2)

    @property
    def _coefficients(self) -> NDArray[np.float64] | None:
        return self.distortion if self.distortion.size else None

    def board(self, points: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """camera_from_board (4, 4) of one picture's corners; None where two poses explain it about equally well."""
        _, turns, shifts, errors = cv2.solvePnPGeneric(points, pixels, self.intrinsics.matrix, self._coefficients, flags=cv2.SOLVEPNP_IPPE)
        residuals = np.asarray(errors).reshape(-1)
        if len(residuals) > 1 and residuals[1] < AMBIGUOUS * residuals[0] and residuals[1] - residuals[0] < APART:
            return None
        return transforms.from_rotvec(turns[0].reshape(3), shifts[0].reshape(3))


@dataclass(frozen=True)
class View:
    """What one camera saw of the board in one shot: ids (N,), pixels (N, 2), depth (N,) metres at the corners (NaN: none);
    world_from_hand (4, 4) where the board is on the hand."""

    camera: str
    shot: int
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    depth: NDArray[np.float64]
    world_from_hand: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Placed:
    """Where a camera stands: world_from_camera (4, 4); rms and largest residual in pixels; how many views and corners; off: two
    standard deviations of a point of the workspace, metres, the worst of them; scale: the board's distance by depth over that by its
    size, NaN without depth; residuals (N, 2) pixels by shot: found less expected."""

    world_from_camera: NDArray[np.float64]
    rms: float
    largest: float
    views: int
    corners: int
    off: float
    scale: float
    residuals: dict[int, NDArray[np.float64]]


@dataclass(frozen=True)
class Calibration:
    """Cameras by name, and where the board sits on the hand (4, 4), None where it lay at a known place."""

    cameras: dict[str, Placed]
    hand_from_board: NDArray[np.float64] | None


def calibrate(
    board: Board,
    lenses: Mapping[str, Lens],
    views: Sequence[View],
    world_from_board: NDArray[np.float64] | None = None,
    allowed: float = ALLOWED,
) -> Calibration:
    """Find the cameras.  world_from_board (4, 4): the board lies there; None: it is on the hand.

    Raises BAD_REQUEST where the views do not suffice, do not agree, or leave a point of the workspace more uncertain than ``allowed``
    metres.
    """
    points = board.corners
    told = [_Seen(view, points[view.ids], lenses[view.camera].board(points[view.ids], view.pixels)) for view in views]
    usable = [seen for seen in told if seen.camera_from_board is not None]
    for name in lenses:
        mine, all_mine = [s for s in usable if s.view.camera == name], [s for s in told if s.view.camera == name]
        if not mine:
            why = (
                f"{len(all_mine)} with the board in it, all of them too far or too square-on to tell how it is tilted"
                if all_mine
                else "none"
            )
            raise MagicError(
                Code.BAD_REQUEST, f"usable pictures of the board by {name}", why, "at least one: nearer, and tilted by 20 to 40 degrees"
            )
        if world_from_board is None:
            _check_turns(name, [s.view for s in mine])
    problem = _Problem(lenses, usable, world_from_board)
    answer = least_squares(problem.residuals, problem.start(), loss="soft_l1", f_scale=1.0, x_scale="jac", method="trf")
    found = problem.placed(answer.x, answer.jac)
    for name, placed in found.cameras.items():
        _check(name, placed, allowed)
    return found


def _check_turns(name: str, views: Sequence[View]) -> None:
    """Refuse shots of a board on the hand that leave the problem open: too few, or all turned about one axis."""
    if len(views) < SHOTS:
        raise MagicError(Code.BAD_REQUEST, f"usable pictures by {name} with the board on the hand", len(views), f"at least {SHOTS}")
    first = views[0].world_from_hand
    assert first is not None
    turns = [
        cv2.Rodrigues((transforms.inverse(first) @ v.world_from_hand)[:3, :3])[0].reshape(3)
        for v in views[1:]
        if v.world_from_hand is not None
    ]
    spread = np.linalg.svd(np.array(turns), compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < SECOND_AXIS:
        raise MagicError(
            Code.BAD_REQUEST,
            f"turns of the hand in the pictures by {name}",
            f"{np.degrees(spread[0]):.0f} degrees about one axis, {np.degrees(spread[1]):.0f} about a second",
            f"at least {np.degrees(SECOND_AXIS):.0f} degrees (rms) about two: tilt the hand to all sides",
        )


def _check(name: str, placed: Placed, allowed: float) -> None:
    if placed.rms > RESIDUAL:
        raise MagicError(
            Code.BAD_REQUEST, f"residual of {name}, pixels rms", round(placed.rms, 2),
            f"at most {RESIDUAL:g}: intrinsics of this resolution, a flat board of the size given, arm and board at rest in each picture",
        )  # fmt: skip
    if np.isfinite(placed.scale) and abs(placed.scale - 1) > SCALE:
        raise MagicError(
            Code.BAD_REQUEST, f"distance of the board by the depth of {name}, over that by the board's size", round(placed.scale, 3),
            f"{1 - SCALE:g} to {1 + SCALE:g}: measure the printed squares (--square), and see the depth unit",
        )  # fmt: skip
    if not placed.off <= allowed:
        raise MagicError(
            Code.BAD_REQUEST, f"uncertainty of a point of the workspace seen by {name}, mm, two standard deviations", round(1000 * placed.off, 1),
            f"at most {1000 * allowed:g}: more pictures, the board nearer, tilted to all sides and at several places of the workspace",
        )  # fmt: skip


@dataclass(frozen=True)
class _Seen:
    view: View
    points: NDArray[np.float64]
    camera_from_board: NDArray[np.float64] | None


class _Problem:
    """The least-squares problem; unknowns: rotation vector and translation of camera_from_world of each camera, then of hand_from_board."""

    def __init__(self, lenses: Mapping[str, Lens], seen: Sequence[_Seen], world_from_board: NDArray[np.float64] | None) -> None:
        self.lenses, self.seen, self.world_from_board = lenses, seen, world_from_board
        self.names = list(lenses)

    def _poses(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        return [transforms.from_rotvec(part[:3], part[3:]) for part in x.reshape(-1, 6)]

    def start(self) -> NDArray[np.float64]:
        """From the views' own poses of the board: at a known place directly, on the hand by OpenCV's hand-eye calibration (Park)."""
        poses, hand_from_board = [], None
        for name in self.names:
            mine = [s for s in self.seen if s.view.camera == name]
            if self.world_from_board is not None:
                poses.append(mine[0].camera_from_board @ transforms.inverse(self.world_from_board))
                continue
            # A camera that stands still and a board on the hand are the camera on the hand seen from the other end.
            hands = [transforms.inverse(s.view.world_from_hand) for s in mine]
            boards = [s.camera_from_board for s in mine]
            turn, shift = cv2.calibrateHandEye(
                [h[:3, :3] for h in hands], [h[:3, 3] for h in hands], [b[:3, :3] for b in boards], [b[:3, 3] for b in boards],
                method=cv2.CALIB_HAND_EYE_PARK,
            )  # fmt: skip
            world_from_camera = transforms.make(turn, shift.reshape(3))
            poses.append(transforms.inverse(world_from_camera))
            if hand_from_board is None:
                hand_from_board = hands[0] @ world_from_camera @ boards[0]
        if hand_from_board is not None:
            poses.append(hand_from_board)
        return np.concatenate([np.concatenate([cv2.Rodrigues(p[:3, :3])[0].reshape(3), p[:3, 3]]) for p in poses])

    def _views(self, x: NDArray[np.float64]) -> list[tuple[_Seen, NDArray[np.float64]]]:
        """Each view with its corners (N, 3) in the camera's frame."""
        poses = self._poses(x)
        result = []
        for seen in self.seen:
            world_from_board = self.world_from_board
            if world_from_board is None:
                world_from_board = seen.view.world_from_hand @ poses[-1]
            camera_from_board = poses[self.names.index(seen.view.camera)] @ world_from_board
            result.append((seen, transforms.apply(camera_from_board, seen.points)))
        return result

    def residuals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2 N,) pixels: found less expected, view by view."""
        return np.concatenate([(s.view.pixels - self.lenses[s.view.camera].project(points)).reshape(-1) for s, points in self._views(x)])

    def placed(self, x: NDArray[np.float64], jacobian: NDArray[np.float64]) -> Calibration:
        """The answer with its residuals and uncertainty."""
        parts: dict[str, dict[int, NDArray[np.float64]]] = {name: {} for name in self.names}
        ratios: dict[str, list[NDArray[np.float64]]] = {name: [] for name in self.names}
        for seen, points in self._views(x):
            name = seen.view.camera
            parts[name][seen.view.shot] = seen.view.pixels - self.lenses[name].project(points)
            ratios[name].append(seen.view.depth / points[:, 2])
        poses = self._poses(x)
        variance = max(float(np.mean(np.concatenate([r.reshape(-1) for rows in parts.values() for r in rows.values()]) ** 2)), DETECTOR**2)
        # Directions that the pictures leave open get a huge variance, and are refused by it.
        information, axes = np.linalg.eigh(jacobian.T @ jacobian)
        covariance = variance * (axes / np.maximum(information, 1e-14 * information.max())) @ axes.T
        cameras = {}
        for index, name in enumerate(self.names):
            every = np.concatenate(list(parts[name].values()))
            lengths = np.linalg.norm(every, axis=1)
            known = np.concatenate(ratios[name])
            known = known[np.isfinite(known)]
            block = covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
            cameras[name] = Placed(
                transforms.inverse(poses[index]), float(np.sqrt(np.mean(lengths**2) / 2)), float(lengths.max()), len(parts[name]), len(every),
                self._off(x[6 * index : 6 * index + 6], block), float(np.median(known)) if len(known) >= CORNERS else float("nan"), parts[name],
            )  # fmt: skip
        return Calibration(cameras, poses[len(self.names)] if self.world_from_board is None else None)

    @staticmethod
    def _off(x: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
        """Two standard deviations of the workspace's worst point, metres: where the camera would put what stands there."""

        def world(values: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
            return transforms.apply(transforms.inverse(transforms.from_rotvec(values[:3], values[3:])), points)

        seen = transforms.apply(transforms.from_rotvec(x[:3], x[3:]), WORKSPACE)
        step = 1e-6
        change = np.stack([(world(x + step * axis, seen) - world(x - step * axis, seen)) / (2 * step) for axis in np.eye(6)], axis=-1)
        spread = change @ covariance @ change.transpose(0, 2, 1)
        return float(2 * np.sqrt(max(np.linalg.eigvalsh(spread).max(), 0.0)))


def drawn(color: NDArray[np.uint8], view: View, residuals: NDArray[np.float64], magnified: float = 20.0) -> NDArray[np.uint8]:
    """A picture of a view: corners found (circles) and their residuals (lines, magnified)."""
    picture = color.copy()
    for (u, v), (du, dv) in zip(view.pixels, residuals, strict=True):
        at = (round(16 * u), round(16 * v))
        end = (round(16 * (u - magnified * du)), round(16 * (v - magnified * dv)))
        cv2.line(picture, at, end, (255, 60, 60), 1, cv2.LINE_AA, 4)
        cv2.circle(picture, at, 16 * 4, (60, 220, 90), 1, cv2.LINE_AA, 4)
    return picture
