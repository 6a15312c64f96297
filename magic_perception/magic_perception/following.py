"""Where a tool is while a hand uses it, by nothing but pictures: its own mesh is followed through RGB-D frames.

The tool lies and is seen whole first; its mesh and pose there are known.  From frame to frame the pose is predicted (constant
velocity, disturbed as a hand disturbs it) and corrected by what the frame shows of the tool:

* measured points lie on the surface that is in sight along their rays: how far they are from it along its normal is a residual; while the
  tool is sought from farther off, their signed distance s(p) is, and its gradient the direction;
* where the model should be seen and the camera looks through to what is behind, the model's point is moved to the nearest pixel
  that is not background: a flat tool that slides in its own plane is held by its outline;
* the outline is moved to where the colours change from the tool's own to those of what is about it, which depth, smeared past every edge,
  does not show (:mod:`magic_perception.tool_colors`).

What is nearer to the camera than the model hides it and says nothing: that is the hand, and whatever else comes between.  What touches
the tool, the hand or the target, is no nearer than it: there its colour tells it, where the tool has another, and it hides the tool as
well unless it is seen to be behind.  What else is of the tool's colour is given up by a loss for what is far (Geman and McClure).
Pictures are taken in the order of their stamps, those of one moment together, so that cameras need not be in step.  What they say is
filtered as they come, and smoothed when all have been seen (:mod:`magic_perception.paths`), where they are doubted as far as they
contradict each other.  With that path the mesh is mended, of which the first look showed only one side
(:mod:`magic_perception.reshaped`), twice, as what meets which ray changes with it, and the pictures are asked again.

The track is lost, and refused, where too much of the model is looked through, or where what is seen leaves it as uncertain as
:data:`UNSURE`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_perception.color_edges import parted
from magic_perception.paths import CLEAR, Seen, State, changed, likeliest, moved, predicted
from magic_perception.reshaped import CLOSE, Aside, Picture, Reshaping, met, raycaster
from magic_perception.tool_colors import Said, ToolColors, lab

Array = NDArray[np.float64]
#: No hand moves a tool by so many standard deviations of what is expected of it from one moment to the next.
JUMP = 3.0
#: What is known when the tool lies: standard deviations of pose (m, rad) and velocity (m/s, rad/s).  Its place is what the mesh was made
#: in: what pictures of the tool on the table say otherwise is what they are wrong in there.  What they say of its turn they say later as
#: well.
START = (0.001, 0.03, 0.01, 0.05)
#: Standard deviation (m) of a measured point from the reconstructed surface, and of an outline; errors hold together over a patch, so
#: that the points of a frame count as so many at most.
NOISE, OUTLINE, WORTH = 0.004, 0.005, 60.0
#: Points farther from the surface than this are not the tool's (m), when the search begins; when it ends, those farther than CLOSE.
REACH = 0.030
#: ... and where it begins from where the tool is expected: what lies farther off is mostly another thing, even of the tool's own colour.
EXPECTED = 0.015
ROUNDS = 16
#: The farthest that the search goes in a round: m, rad.
STRIDE = (0.02, np.deg2rad(12.0))
#: ... and where that does not find the tool.
FAR = 0.06
#: So often (s) two cameras are asked each by itself, and how little is known of the tool then beside what they see: as START.
ALONE, LOOSE = 0.5, (0.015, 0.3, 0.1, 0.5)
#: The tool has not moved yet while it is nearer than this (m, rad) to where it lay; so well (m, rad) is it known where it is until then;
#: and every so many seconds afterwards a moment is asked what the tool's surface is like.
STILL, LIES, RESHAPED = (0.005, 0.05), (0.0005, 0.003), 0.4
#: Pictures whose stamps differ by no more (s) are of one moment.
AT_ONCE = 0.01
#: Measured points used of a frame, and points of the surface that stand for the model.
USED, SURFACE = 700, 900
#: A camera looks through where it measures more than this (m) behind the model; what is so much nearer hides it.
BEHIND, HIDES = 0.012, 0.005
#: What is nearer to the table than this is taken for it (m).
TABLE = 0.004
#: How far from the outline a point that is looked through may be (pixels), and from how far on it tells of the pose: nearer, depth is
#: rounded, lost and smeared, nothing weighs against that where a hand hides the other end, and colours tell where the outline is.
ASTRAY, SLACK = 25, 2.5
#: What is about the tool in a picture, from half of BESIDE to AROUND pixels from its outline, is background.
BESIDE, AROUND = 7, 20
#: A pixel counts as this share of one that is independent of its neighbours.
SHARED = 0.3
#: So far (pixels) the outline is sought by its colours to either side, first and last; at so many places; standard deviation (pixels) of
#: one that is found sharply, and so many places count as independent.
SOUGHT, PLACES, SHARP, LINES = (6, 3), 120, 0.8, 40.0
#: Of the points that should be seen, so many may be looked through; fewer than FEWEST say nothing.
THROUGH, FEWEST = 0.35, 25
#: A frame in which the tool was not found is left out; so long (s) none may be.
BLIND = 0.4
#: As unsure as a track may be: standard deviations, m and rad.
UNSURE = (0.006, np.deg2rad(5.0))


@dataclass(frozen=True)
class Followed:
    """times (T,) of the moments, s; world_from_tool (T, 4, 4); shift (T,) m and turn (T,) rad: standard deviations, of the worst direction;
    seen: moments in which the tool was found; surface: how the tool's own is mended by the pictures."""

    times: Array
    world_from_tool: Array
    shift: Array
    turn: Array
    seen: int
    surface: Reshaping


@dataclass(frozen=True)
class _View:
    """A part of a picture with the tool drawn alone: rows, columns; mask (h, w), depth (h, w) in m, infinite beside it."""

    rows: slice
    columns: slice
    mask: NDArray[np.bool_]
    depth: NDArray[np.float32]


class Follower:
    """One tool's mesh, ready to be found in frames.

    mesh: closed, in its own frame; world_from_tool (4, 4) where it lies; table (4,): plane with its unit normal up; others: what else is
    there at first, in the world.
    """

    def __init__(self, mesh: Mesh, world_from_tool: Array, table: Array, others: Sequence[Mesh] = (), seed: int = 0) -> None:
        self._scene = raycaster(mesh)
        self._others = tuple(others)
        sampled = mesh.to_trimesh()
        rng = np.random.default_rng(seed)
        corners = np.asarray(sampled.triangles)
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(crosses, axis=1)
        face = rng.choice(len(areas), SURFACE, p=areas / areas.sum())
        self._points = np.einsum("ni,nij->nj", rng.dirichlet(np.ones(3), SURFACE), corners[face])
        self._normals = crosses[face] / areas[face][:, None]
        self._bounds = mesh.bounds
        self.middle = self._bounds.mean(axis=0)
        self._radius = float(np.linalg.norm(mesh.vertices - self.middle, axis=1).max())
        self._table = np.asarray(table, dtype=float)
        self._lying = np.asarray(world_from_tool, dtype=float)
        self.colors = ToolColors()
        self._before: dict[str, RgbdFrame] = {}
        self._rng = rng

    @property
    def surface(self) -> tuple[Array, Array]:
        """Points (N, 3) on the surface and its normals there (N, 3), in the tool's frame."""
        return self._points, self._normals

    def mended(self, mesh: Mesh) -> Follower:
        """The same tool by another mesh, with what was learned of its colours."""
        other = Follower(mesh, self._lying, self._table, self._others)
        other.colors, other._before = self.colors, self._before
        return other

    # ------------------------------------------------------------ one frame

    def learn_colors(self, frames: Sequence[RgbdFrame]) -> None:
        """Take the tool's colours, and those of what is about it, from frames in which it lies as it was first seen."""
        own, ground = [], []
        for frame in frames:
            view = self._drawn(frame, self._lying)
            if view is None:
                continue
            self._before[frame.camera] = frame
            colors, (inside, outside) = lab(frame), self._sides(frame, view)
            own.append(colors[inside & np.isfinite(frame.depth)])
            ground.append(colors[outside])
        if sum(map(len, own)) >= FEWEST:
            others = [np.concatenate([lab(frame)[_shown(frame, mesh)] for frame in frames]) for mesh in self._others]
            self.colors.learn(np.concatenate(own), np.concatenate(ground), [colors for colors in others if len(colors) >= FEWEST])

    def see_around(self, frames: Sequence[RgbdFrame], pose: Array) -> None:
        """Take the colours of what is not the tool now: of other ground about it, and of what has come into the pictures, the hand."""
        for frame in frames:
            view = self._drawn(frame, pose)
            if view is None:
                continue
            colors, (_, outside) = lab(frame), self._sides(frame, view)
            about = colors[view.rows, view.columns][outside[view.rows, view.columns]]
            if len(about) >= FEWEST:
                self.colors.see_ground(about)
            come = colors[self._come(frame) & outside]
            if len(come) >= FEWEST:
                self.colors.see_moving(come)

    def _sides(self, frame: RgbdFrame, view: _View) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Pixels (H, W) of the drawn tool, and those surely beside it."""
        mask = np.zeros(frame.depth.shape, np.uint8)
        mask[view.rows, view.columns] = view.mask
        return mask > 0, cv2.dilate(mask, np.ones((BESIDE, BESIDE))) == 0

    def _come(self, frame: RgbdFrame) -> NDArray[np.bool_]:
        """Where a camera that stands still measures something nearer than before the tool was taken, (H, W)."""
        before = self._before.get(frame.camera)
        if (
            before is None
            or before.depth.shape != frame.depth.shape
            or not np.allclose(before.world_from_camera, frame.world_from_camera, atol=1e-3)
        ):
            return np.zeros(frame.depth.shape, bool)
        with np.errstate(invalid="ignore"):
            return frame.depth < before.depth - 2 * BEHIND

    def _drawn(self, frame: RgbdFrame, pose: Array) -> _View | None:
        """The tool as a camera would see it alone at a pose, with AROUND pixels about it; None where it is outside the picture."""
        points = transforms.apply(transforms.inverse(frame.world_from_camera) @ pose, self._points)
        if points[:, 2].min() < 0.1:
            return None
        pixels = frame.intrinsics.project(points)
        height, width = frame.depth.shape
        u0, v0 = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - AROUND, 0)
        u1, v1 = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + AROUND + 1, [width, height])
        if u1 - u0 < 3 or v1 - v0 < 3:
            return None
        u, v = np.meshgrid(np.arange(u0, u1), np.arange(v0, v1))
        k = frame.intrinsics
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
        tool_from_camera = transforms.inverse(pose) @ frame.world_from_camera
        rays = np.concatenate([np.broadcast_to(tool_from_camera[:3, 3], rays.shape), rays @ tool_from_camera[:3, :3].T], axis=-1)
        depth = self._scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
        return _View(slice(int(v0), int(v1)), slice(int(u0), int(u1)), np.isfinite(depth), depth)

    def _near(self, points: Array, pose: Array, reach: float) -> tuple[Array, Array, Array]:
        """Those of world points (M, 3) that are nearer than ``reach`` to the surface, their signed distance (M,) and its gradient (M, 3) in
        the world."""
        local = transforms.apply(transforms.inverse(pose), points)
        # What is farther from the mesh's box is farther from the mesh.
        boxed = ((local > self._bounds[0] - reach) & (local < self._bounds[1] + reach)).all(axis=1)
        points, local = points[boxed], local[boxed].astype(np.float32)
        closest = self._scene.compute_closest_points(o3d.core.Tensor(local))
        away = local - closest["points"].numpy().astype(float)
        length = np.linalg.norm(away, axis=1)
        near = length < reach
        points, local, away, length = points[near], local[near], away[near], length[near]
        side = 1 - 2 * self._scene.compute_occupancy(o3d.core.Tensor(local)).numpy().astype(float)
        gradient = np.where(
            length[:, None] > 2e-4, side[:, None] * away / np.maximum(length, 1e-9)[:, None], closest["primitive_normals"].numpy()[near]
        )
        return points, side * length, gradient @ pose[:3, :3].T

    def _met(self, frame: RgbdFrame, points: Array, pose: Array) -> tuple[Array, Array, Array]:
        """As :meth:`_near`, by the surface that the camera sees along the rays to the points."""
        tool_from_world = transforms.inverse(pose)
        off, normals, _, which = met(
            self._scene, transforms.apply(tool_from_world, points), transforms.apply(tool_from_world, frame.world_from_camera[:3, 3])
        )
        return points[which], off, normals @ pose[:3, :3].T

    def _measured(self, frame: RgbdFrame, pose: Array) -> tuple[Array, NDArray[np.int64]]:
        """World points (N, 3) above the table about the tool, and their pixels (N, 2)."""
        camera = transforms.apply(transforms.inverse(frame.world_from_camera), transforms.apply(pose, self.middle))
        if camera[2] < 0.1:
            return np.zeros((0, 3)), np.zeros((0, 2), np.int64)
        centre = frame.intrinsics.project(camera)
        reach = (self._radius + FAR) * frame.intrinsics.fx / camera[2] * 1.2
        height, width = frame.depth.shape
        u0, v0 = np.maximum(np.floor(centre - reach), 0).astype(int)
        u1, v1 = np.minimum(np.ceil(centre + reach), [width - 1, height - 1]).astype(int)
        if u1 <= u0 or v1 <= v0:
            return np.zeros((0, 3)), np.zeros((0, 2), np.int64)
        depth = frame.depth[v0 : v1 + 1, u0 : u1 + 1]
        v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
        z = depth[v, u].astype(float)
        pixels = np.column_stack([u + u0, v + v0])
        rays = np.column_stack(
            [
                (pixels[:, 0] - frame.intrinsics.cx) / frame.intrinsics.fx,
                (pixels[:, 1] - frame.intrinsics.cy) / frame.intrinsics.fy,
                np.ones(len(z)),
            ]
        )
        points = transforms.apply(frame.world_from_camera, rays * z[:, None])
        about = np.linalg.norm(points - transforms.apply(pose, self.middle), axis=1) < self._radius + FAR
        about &= points @ self._table[:3] + self._table[3] > TABLE
        return points[about], pixels[about]

    def _model(self, frame: RgbdFrame, pose: Array) -> tuple[Array, Array, NDArray[np.int64], Array]:
        """Points of the surface that face the camera and that the tool itself does not hide, in the picture: world (N, 3), depth (N,),
        pixels (N, 2), pixels as numbers (N, 2)."""
        points = transforms.apply(pose, self._points)
        eye = frame.world_from_camera[:3, 3]
        facing = ((eye - points) * (self._normals @ pose[:3, :3].T)).sum(axis=1) > 0
        local = transforms.apply(transforms.inverse(pose), eye)
        rays = np.concatenate([np.tile(local, (len(self._points), 1)), self._points - local], axis=1).astype(np.float32)
        first = self._scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        points = points[facing & (first > 1 - 2e-3)]
        camera = transforms.apply(transforms.inverse(frame.world_from_camera), points)
        fine = camera[:, 2] > 0.1
        points, camera = points[fine], camera[fine]
        places = frame.intrinsics.project(camera)
        pixels = np.round(places).astype(int)
        height, width = frame.depth.shape
        inside = (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
        return points[inside], camera[inside, 2], pixels[inside], places[inside]

    def looked_at(self, frames: Sequence[RgbdFrame], pose: Array) -> tuple[int, int, int]:
        """Points of the model by what the frames show there: the tool, what is behind it, what hides it."""
        counts = np.zeros(3, dtype=int)
        for frame in frames:
            _, depth, pixels, _ = self._model(frame, pose)
            seen = frame.depth[pixels[:, 1], pixels[:, 0]]
            known = np.isfinite(seen) & (seen > 0)
            gap = seen[known] - depth[known]
            counts += [(np.abs(gap) <= BEHIND).sum(), (gap > BEHIND).sum(), (gap < -BEHIND).sum()]
        on, through, hidden = (int(count) for count in counts)
        return on, through, hidden

    def _outlined(self, frame: RgbdFrame, pose: Array, colors: Said, sought: int) -> tuple[Array, Array]:
        """What the colours of a frame say at a pose, as :meth:`_information`: the outline is moved to where they change."""
        off, along, places, sure = self.outline(frame, pose, colors, sought)
        jacobian = np.concatenate([along, np.cross(places - transforms.apply(pose, self.middle), along)], axis=1)
        return (jacobian * sure[:, None]).T @ jacobian, (jacobian * sure[:, None]).T @ off

    def outline(self, frame: RgbdFrame, pose: Array, colors: Said, sought: int) -> Aside:
        """How far along its normals the drawn outline is from where the colours change.

        Along the normal of each place of the drawn outline the tool's profile (inside, outside, and inside again behind a slit) is shifted
        until it agrees best with the colours; its mean shift and how sharp that is make the residual and its weight (after Stoiber and
        others, "Iterative Corresponding Geometry", CVPR 2022).  There the edge is sought (:mod:`magic_perception.color_edges`).  What is
        hidden says nothing, nor does a place with no edge.
        """
        none = Aside(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        view = self._drawn(frame, pose)
        if view is None or not view.mask.any():
            return none
        seen = frame.depth[view.rows, view.columns]
        nearest = cv2.erode(np.where(view.mask, view.depth, 1e3).astype(np.float32), np.ones((2 * sought + 1,) * 2))
        said, touches = colors.tool[view.rows, view.columns], colors.touches[view.rows, view.columns]
        # What lies on the tool, or touches it, hides it as well, and is told from it by its colour.
        hidden = (seen < nearest - BEHIND) | ((seen < nearest - HIDES) & (said < 0)) | (touches & ~(seen > nearest + BEHIND))
        said = np.where(hidden, 0, said).astype(np.float32)
        soft = cv2.GaussianBlur(view.mask.astype(np.float32), (0, 0), 1.5)
        slope = np.stack([cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)], axis=-1)
        inner = view.mask & (cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3)), borderValue=0) == 0)
        rows, columns = np.nonzero(inner & (np.linalg.norm(slope, axis=-1) > 0.05) & ~hidden)
        if len(rows) < 6:
            return none
        if len(rows) > PLACES:
            chosen = np.linspace(0, len(rows) - 1, PLACES).astype(int)
            rows, columns = rows[chosen], columns[chosen]
        normal = -slope[rows, columns]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        along = np.arange(-2 * sought, 2 * sought + 1)
        u = (columns[:, None] + along * normal[:, :1]).astype(np.float32)
        v = (rows[:, None] + along * normal[:, 1:]).astype(np.float32)
        profile = 2 * cv2.remap(view.mask.astype(np.float32), u, v, cv2.INTER_LINEAR, borderValue=0) - 1
        evidence = cv2.remap(said, u, v, cv2.INTER_LINEAR, borderValue=0)
        shifts = np.arange(-sought, sought + 1)
        middle = slice(sought, 3 * sought + 1)
        # The profile shifted by d, where it is known for all d.
        score = np.stack([(profile[:, sought - d : 3 * sought + 1 - d] * evidence[:, middle]).sum(axis=1) for d in shifts], axis=1)
        weight = np.exp(SHARED * (score - score.max(axis=1, keepdims=True)))
        weight /= weight.sum(axis=1, keepdims=True)
        shift = weight @ shifts
        spread = weight @ shifts**2 - shift**2
        drawn, room = _drawn_edges(profile)
        starts = np.column_stack([columns, rows])
        edge, found = parted(frame.color[view.rows, view.columns], hidden, starts, normal, drawn + shift, room)
        found &= np.abs(shift) < sought
        shift = edge - drawn
        depth = view.depth[rows, columns].astype(float)
        places = np.column_stack([columns + view.columns.start, rows + view.rows.start])
        k = frame.intrinsics
        rays = np.column_stack([(places[:, 0] - k.cx) / k.fx, (places[:, 1] - k.cy) / k.fy, np.ones(len(places))])
        points = transforms.apply(frame.world_from_camera, rays * depth[:, None])
        axis = normal @ frame.world_from_camera[:3, :2].T
        scale = depth / k.fx
        sure = found / ((spread + SHARP**2) * scale**2) * np.clip(1 - spread / (sought**2 / 3), 0, 1)
        return Aside(shift * scale, axis, points, sure * min(1.0, LINES / len(sure)))

    def _information(self, frame: RgbdFrame, pose: Array, measured: tuple[Array, NDArray[np.bool_]], reach: float) -> tuple[Array, Array]:
        """What a frame's depth says at a pose: (6, 6) and (6,), of a change of the pose as :func:`moved` takes it."""
        middle = transforms.apply(pose, self.middle)
        points, own = measured
        matrix, vector = np.zeros((6, 6)), np.zeros(6)
        points, signed, gradient = self._near(points[own], pose, reach) if reach > CLOSE else self._met(frame, points[own], pose)
        if len(points) >= 6:
            # Points move with the tool's frame the other way: a shift of the tool by d lowers the distance by gradient . d.
            jacobian = np.concatenate([gradient, np.cross(points - middle, gradient)], axis=1)
            matrix, vector = _add(matrix, vector, jacobian, signed, NOISE, reach)
        on, depth, pixels, places = self._model(frame, pose)
        if len(on):
            crop = _crop(pixels, frame.depth.shape, ASTRAY)
            v0, v1, u0, u1 = crop
            seen = frame.depth[v0:v1, u0:u1]
            # Background: measured, and behind all of the tool that may be near; what is lost or nearer is not.
            plane = _plane_depth(frame, self._table, crop)
            behind = np.isfinite(seen) & (seen > 0) & ((seen > depth.max() + BEHIND) | (np.abs(seen - plane) < 2 * TABLE))
            local = pixels - [u0, v0]
            through = behind[local[:, 1], local[:, 0]] & (frame.depth[pixels[:, 1], pixels[:, 0]] > depth + BEHIND / 2)
            if through.any() and not behind.all():
                away, label = cv2.distanceTransformWithLabels(behind.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
                v, u = np.nonzero(~behind)
                nearest = np.zeros((int(label.max()) + 1, 2))
                nearest[label[v, u]] = np.column_stack([u, v])
                rows = local[through]
                far = away[rows[:, 1], rows[:, 0]]
                goal = nearest[label[rows[:, 1], rows[:, 0]]] + [u0, v0]
                step = goal - places[through]
                length = np.linalg.norm(step, axis=1)
                fits = (far < ASTRAY) & (length > SLACK)
                if fits.any():
                    direction = step[fits] / length[fits][:, None]
                    scale = depth[through][fits] / frame.intrinsics.fx
                    axis = direction @ frame.world_from_camera[:3, :2].T
                    lever = on[through][fits] - middle
                    jacobian = np.concatenate([axis, np.cross(lever, axis)], axis=1)
                    matrix, vector = _add(matrix, vector, jacobian, length[fits] * scale, OUTLINE, REACH)
        return matrix, vector

    def correct(self, frames: Sequence[RgbdFrame], state: State, before: Array, compare: bool = False) -> tuple[State, Seen | None]:
        """The state after the frames of one moment, and what they say there, ``None`` where the tool was not found in them; before (4, 4):
        where it was last; compare: what two of them say, each by itself."""
        measured, colors = self._shown(frames, state.pose)
        best, least = None, 1.0
        # A hand that stops or turns is not where it was going: then from where the tool was, and from farther off.
        for start, reach in ((state.pose, EXPECTED), (before, REACH), (state.pose, FAR), (before, FAR)):
            fitted = self._fitted(frames, measured, colors, state, start, reach)
            on, through, _ = self.looked_at(frames, fitted.pose)
            share = through / max(on + through, 1)
            jump = changed(fitted.pose, state.pose, self.middle)
            if jump @ np.linalg.solve(state.covariance[:6, :6], jump) > JUMP**2:
                continue
            if on >= FEWEST and share <= THROUGH and share < least:
                best, least = fitted, share
            if best is not None and least < CLEAR:
                break
        if best is None:
            return state, None
        return best, self._told(frames, measured, colors, best.pose, least, compare)

    def again(self, frames: Sequence[RgbdFrame], pose: Array, compare: bool = False) -> Seen | None:
        """What the frames of one moment say about a pose (4, 4) in which the tool was found before, as :meth:`correct`."""
        measured, colors = self._shown(frames, pose)
        found = self._fitted(frames, measured, colors, State(pose, np.zeros(6), np.diag(np.repeat(LOOSE, 3)) ** 2), pose, EXPECTED).pose
        on, through, _ = self.looked_at(frames, found)
        share = through / max(on + through, 1)
        return self._told(frames, measured, colors, found, share, compare) if on >= FEWEST and share <= THROUGH else None

    def pictures(self, frames: Sequence[RgbdFrame], pose: Array) -> list[Picture]:
        """What the frames of one moment show of the surface of the tool, about a pose (4, 4)."""
        measured, colors = self._shown(frames, pose)
        return [
            Picture(points[own], frame.world_from_camera[:3, 3], self.outline(frame, pose, said, SOUGHT[1]))
            for frame, (points, own), said in zip(frames, measured, colors, strict=True)
        ]

    def _shown(self, frames: Sequence[RgbdFrame], pose: Array) -> tuple[list[tuple[Array, NDArray[np.bool_]]], list[Said]]:
        """Of each frame some of the measured points about a pose, and which have the tool's colour; and what its colours say."""
        measured, colors = [], []
        for frame in frames:
            points, pixels = self._measured(frame, pose)
            colors.append(self.colors.said(frame))
            own = colors[-1].tool[pixels[:, 1], pixels[:, 0]] > 0
            if len(points) > USED:
                chosen = self._rng.choice(len(points), USED, replace=False)
                points, own = points[chosen], own[chosen]
            measured.append((points, own))
        return measured, colors

    def _told(
        self,
        frames: Sequence[RgbdFrame],
        measured: list[tuple[Array, NDArray[np.bool_]]],
        colors: list[Said],
        pose: Array,
        through: float,
        compare: bool,
    ) -> Seen:
        """What frames say at a pose; compare: each by itself as well."""
        said = [self._said(*seen, pose, CLOSE, SOUGHT[1]) for seen in zip(frames, measured, colors, strict=True)]
        matrix, vector = (np.sum([one[k] for one in said], axis=0) for k in range(2))
        apart = self._compared(frames, measured, colors, pose) if compare and len(frames) > 1 else math.nan
        return Seen(pose, matrix, vector, through, apart)

    def _compared(
        self, frames: Sequence[RgbdFrame], measured: list[tuple[Array, NDArray[np.bool_]]], colors: list[Said], pose: Array
    ) -> float:
        """How far apart the first two frames, each by itself, say the tool to be about a pose: a chi-squared over its degrees of
        freedom."""
        loose = State(pose, np.zeros(6), np.diag(np.repeat(LOOSE, 3)) ** 2)
        one, other = (self._fitted([frames[k]], [measured[k]], [colors[k]], loose, pose, EXPECTED) for k in range(2))
        off = changed(one.pose, other.pose, self.middle)
        return float(off @ np.linalg.solve((one.covariance + other.covariance)[:6, :6], off)) / len(off)

    def _said(
        self, frame: RgbdFrame, measured: tuple[Array, NDArray[np.bool_]], colors: Said, pose: Array, reach: float, sought: int
    ) -> tuple[Array, Array]:
        """What a frame says at a pose by depth and colours: (6, 6) and (6,), as :meth:`_information`."""
        information, pull = self._information(frame, pose, measured, reach)
        outlined, shift = self._outlined(frame, pose, colors, sought)
        return information + outlined, pull + shift

    def _fitted(
        self,
        frames: Sequence[RgbdFrame],
        measured: list[tuple[Array, NDArray[np.bool_]]],
        colors: list[Said],
        state: State,
        start: Array,
        far: float,
    ) -> State:
        """The most likely state by what is expected and what is seen, sought from a pose (4, 4)."""
        prior = np.linalg.inv(state.covariance)
        pose, velocity = start, state.velocity
        matrix = prior
        for turn in range(ROUNDS):
            reach = CLOSE + (far - CLOSE) * max(0.0, 1 - 2 * turn / ROUNDS)
            off = np.concatenate([changed(pose, state.pose, self.middle), velocity - state.velocity])
            matrix, vector = prior.copy(), -prior @ off
            sought = round(SOUGHT[1] + (SOUGHT[0] - SOUGHT[1]) * max(0.0, 1 - 2 * turn / ROUNDS))
            for seen in zip(frames, measured, colors, strict=True):
                information, pull = self._said(*seen, pose, reach, sought)
                matrix[:6, :6] += information
                vector[:6] += pull
            change = np.linalg.solve(matrix, vector)
            change *= min(
                1.0, *(most / max(np.linalg.norm(part), 1e-12) for most, part in zip(STRIDE, np.split(change[:6], 2), strict=True))
            )
            pose, velocity = moved(pose, self.middle, change[:6]), velocity + change[6:]
            if reach == CLOSE and np.abs(change[:6]).max() < 2e-5:
                break
        return State(pose, velocity, np.linalg.inv(matrix))


def _drawn_edges(profile: Array) -> tuple[Array, Array]:
    """Where on lines (K, 2n + 1) from inside a drawn thing (1) out of it (-1) its edge is, (K,) pixels from their middles, which are its
    outermost pixels; and half of what there is of it to the inner side and of nothing to the outer, (K, 2) pixels."""
    middle = profile.shape[1] // 2
    outside = profile[:, middle + 1 :] <= 0
    first = np.where(outside.any(axis=1), outside.argmax(axis=1), 0)
    before, after = (np.take_along_axis(profile, (middle + first + k)[:, None], axis=1)[:, 0] for k in range(2))
    edge = first + np.where(after < before, before / np.maximum(before - after, 1e-6), 0.5)
    within = edge + _run(profile[:, middle::-1] > 0) - 0.5
    beside = _run(np.where(np.arange(middle) < first[:, None], True, outside)) - first
    return edge, np.column_stack([within, beside]) / 2


def _run(true: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many (K,) of the first of (K, n) are true."""
    return np.where(true.all(axis=1), true.shape[1], (~true).argmax(axis=1))


def _add(matrix: Array, vector: Array, jacobian: Array, residual: Array, noise: float, reach: float) -> tuple[Array, Array]:
    weight = (1 / (1 + (residual / (reach / 2)) ** 2)) ** 2 / noise**2
    weight *= min(1.0, WORTH / len(residual))
    return matrix + (jacobian * weight[:, None]).T @ jacobian, vector + (jacobian * weight[:, None]).T @ residual


def _shown(frame: RgbdFrame, mesh: Mesh) -> NDArray[np.bool_]:
    """Pixels (H, W), but for those at its edge, in which a thing is seen where it is in the world."""
    v, u = np.indices(frame.depth.shape)
    k = frame.intrinsics
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1) @ frame.world_from_camera[:3, :3].T
    rays = np.concatenate([np.broadcast_to(frame.world_from_camera[:3, 3], rays.shape), rays], axis=-1)
    depth = raycaster(mesh).cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    seen = np.isfinite(depth) & (np.abs(depth - frame.depth) < BEHIND)
    return cv2.erode(seen.astype(np.uint8), np.ones((3, 3))) > 0


def _crop(pixels: NDArray[np.int64], shape: tuple[int, ...], margin: int) -> tuple[int, int, int, int]:
    (u0, v0), (u1, v1) = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin + 1
    return max(int(v0), 0), min(int(v1), shape[0]), max(int(u0), 0), min(int(u1), shape[1])


def _plane_depth(frame: RgbdFrame, plane: Array, crop: tuple[int, int, int, int]) -> Array:
    """Depth (h, w) of a plane of the world in a part of a picture."""
    v0, v1, u0, u1 = crop
    u, v = np.meshgrid(np.arange(u0, u1), np.arange(v0, v1))
    k = frame.intrinsics
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u, dtype=float)], axis=-1) @ frame.world_from_camera[:3, :3].T
    down = rays @ plane[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -(frame.world_from_camera[:3, 3] @ plane[:3] + plane[3]) / down
    return np.where(depth > 0, depth, np.inf)


def follow(mesh: Mesh, world_from_tool: Array, table: Array, frames: Iterable[RgbdFrame], others: Sequence[Mesh] = ()) -> Followed:
    """The tool's track through frames in the order of their stamps, of the first of which it is known that it lies at ``world_from_tool``;
    others: what else is there then, in the world.  The frames are gone through four times.

    Raises BAD_MOTION where it is lost, with the moment and what was seen; NO_FRAMES without two frames.
    """
    follower = Follower(mesh, world_from_tool, table, others)
    start = State(np.asarray(world_from_tool, dtype=float), np.zeros(6), np.diag(np.repeat(START, 3) ** 2))
    times, told = _found(follower, start, frames)
    smooth = likeliest(start, times, told, follower.middle)
    path = {now: state.pose for now, state in zip(times, smooth, strict=True)}
    first, _ = _mended(Reshaping(mesh, *follower.surface), follower, _moments(frames), path.get)
    shape = first.mended()[0]
    follower = follower.mended(shape)
    surface, _ = _mended(Reshaping(shape, *follower.surface, first), follower, _moments(frames), path.get)
    mended = Follower(surface.mended()[0], world_from_tool, table, others)
    told = _again(mended, told, smooth, frames)
    smooth = likeliest(start, times, told, mended.middle)
    shift = np.sqrt([np.linalg.eigvalsh(s.covariance[:3, :3])[-1] for s in smooth])
    turn = np.sqrt([np.linalg.eigvalsh(s.covariance[3:6, 3:6])[-1] for s in smooth])
    kept = _known(times, shift, turn)
    times, smooth, shift, turn = times[:kept], smooth[:kept], shift[:kept], turn[:kept]
    worst = int(np.argmax(np.maximum(shift / UNSURE[0], turn / UNSURE[1])))
    if shift[worst] > UNSURE[0] or turn[worst] > UNSURE[1]:
        raise MagicError(
            Code.BAD_MOTION,
            f"where the tool is {times[worst] - times[0]:.2f} s after the first picture",
            f"known to {1000 * shift[worst]:.1f} mm and {np.degrees(turn[worst]):.1f} degrees (standard deviations)",
            f"{1000 * UNSURE[0]:g} mm and {np.degrees(UNSURE[1]):g} degrees: more of it in sight, nearer cameras that are not moved, or more pictures a second",
        )
    return Followed(times, np.stack([s.pose for s in smooth]), shift, turn, sum(seen is not None for seen in told), surface)


def _found(follower: Follower, start: State, frames: Iterable[RgbdFrame]) -> tuple[Array, list[Seen | None]]:
    """The times (T,) of the moments and what was seen in them; raises BAD_MOTION where the tool is lost, NO_FRAMES."""
    state = start
    times: list[float] = []
    told: list[Seen | None] = []
    last, compared = math.nan, -math.inf
    for moment in _moments(frames):
        now = moment[-1].stamp
        if not times:
            last = now
            follower.learn_colors(moment)
        expected, _ = predicted(state, follower.middle, now - times[-1] if times else 0.0)
        compare = now - compared >= ALONE
        compared = now if compare else compared
        state, seen = follower.correct(moment, expected, state.pose, compare)
        times.append(now)
        told.append(seen)
        if seen is not None:
            follower.see_around(moment, state.pose)
            last = now
        elif now - last > BLIND:
            on, through, hidden = follower.looked_at(moment, state.pose)
            raise MagicError(
                Code.BAD_MOTION,
                f"the tool is lost {last - times[0]:.2f} s after the first picture; of its surface, {now - last:.2f} s later",
                f"{on} points seen, {through} looked through, {hidden} hidden",
                f"at least {FEWEST} seen, at most {100 * THROUGH:.0f} % looked through: not too fast for the cameras, the hand not over all of it",
            )
    if len(times) < 2:
        raise MagicError(Code.NO_FRAMES, "pictures to follow the tool in", len(times), "two or more")
    return np.array(times), told


def reshaped_along(
    mesh: Mesh, world_from_tool: Array, table: Array, frames: Iterable[RgbdFrame], times: Array, poses: Array, others: Sequence[Mesh] = ()
) -> tuple[Reshaping, int]:
    """How the pictures mend the surface of a tool whose path something else tells, poses (T, 4, 4) at times (T,) of which the first is
    where it lies, and in how many moments of its use they show it; mesh, world_from_tool, table and others: as :func:`follow`.

    Another clock and a marker's calibration are not those of the pictures: where the tool is in a moment is sought about what the path
    says.
    """
    follower = Follower(mesh, world_from_tool, table, others)

    def pose_at(now: float) -> Array | None:
        return transforms.interpolate(times, poses, [now])[0] if now <= times[-1] else None

    def sought(moment: list[RgbdFrame], pose: Array) -> Array | None:
        seen = follower.again(moment, pose)
        return None if seen is None or seen.through > CLEAR else seen.pose

    def moments() -> Iterator[list[RgbdFrame]]:
        for k, moment in enumerate(_moments(frames)):
            if k == 0:
                follower.learn_colors(moment)
            yield moment
            if (pose := pose_at(moment[-1].stamp)) is not None:
                follower.see_around(moment, pose)

    return _mended(Reshaping(mesh, *follower.surface), follower, moments(), pose_at, sought)


def _mended(
    reshaping: Reshaping,
    follower: Follower,
    moments: Iterable[list[RgbdFrame]],
    pose_at: Callable[[float], Array | None],
    sought: Callable[[list[RgbdFrame], Array], Array | None] = lambda _, pose: pose,
) -> tuple[Reshaping, int]:
    """What is said of the surface, with what all pictures show of it, most of all those in which it has not moved yet, and how many later
    moments there were.

    pose_at: the pose (4, 4) at a time, None from the end of what is known on; sought: where exactly it is in the frames of a moment, if
    that is seen.
    """
    lying, moves, told, shown = None, False, -math.inf, 0
    for moment in moments:
        now = moment[-1].stamp
        if (pose := pose_at(now)) is None:
            break
        lying = pose if lying is None else lying
        moves = moves or bool((np.abs(changed(pose, lying, follower.middle)) > np.repeat(STILL, 3)).any())
        if moves and now - told < RESHAPED:
            continue
        told, known = now, LOOSE[:2] if moves else LIES
        if (pose := sought(moment, pose) if moves else lying) is not None:
            reshaping.see(follower.pictures(moment, pose), pose, follower.middle, np.diag(np.repeat(known, 3) ** -2.0))
            shown += moves
    return reshaping, shown


def _again(follower: Follower, told: Sequence[Seen | None], path: Sequence[State], frames: Iterable[RgbdFrame]) -> list[Seen | None]:
    """What was seen in the moments, asked again about the path where it was found."""
    again: list[Seen | None] = []
    for k, (seen, state, moment) in enumerate(zip(told, path, _moments(frames), strict=True)):
        if k == 0:
            follower.learn_colors(moment)
        again.append(None if seen is None else follower.again(moment, state.pose, math.isfinite(seen.apart)))
        if seen is not None:
            follower.see_around(moment, state.pose)
    return again


def _known(times: Array, shift: Array, turn: Array) -> int:
    """How many of the moments (T,) there are without those at the end, BLIND seconds at most, that are not sure: no later picture tells of
    them."""
    sure = np.flatnonzero((shift <= UNSURE[0]) & (turn <= UNSURE[1]))
    return int(sure[-1]) + 1 if len(sure) and times[-1] - times[sure[-1]] <= BLIND else len(times)


def _moments(frames: Iterable[RgbdFrame]) -> Iterator[list[RgbdFrame]]:
    """The frames of each moment together; raises BAD_MOTION for stamps that go back."""
    group: list[RgbdFrame] = []
    for frame in frames:
        if group and frame.stamp < group[-1].stamp:
            back = f"{group[-1].stamp - frame.stamp:.3f} s back"
            raise MagicError(Code.BAD_MOTION, f"stamp of a picture of {frame.camera}", back, "pictures in the order of their stamps")
        if group and frame.stamp - group[0].stamp > AT_ONCE:
            yield group
            group = []
        group.append(frame)
    if group:
        yield group
