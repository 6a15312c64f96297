"""Between messages and plain types: the only module that knows both.

``x_to_msg`` makes a message, ``x_from_msg`` a plain type; images keep no
reference to the message's buffer.  Bad content raises :class:`MagicError`.
"""

from __future__ import annotations

import copy
import math
import struct
from collections.abc import Iterable, Sequence
from operator import attrgetter

import cv2
import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from shape_msgs.msg import Mesh as MeshMsg
from shape_msgs.msg import MeshTriangle, Plane
from std_msgs.msg import Header
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from magic_core import depth as depths
from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.contact import Companion, Contact, ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.surface import PrincipalFrame
from magic_core.tf import TransformBuffer
from magic_interfaces import msg as mi

# ---------------------------------------------------------------- time and header


def time_to_msg(seconds: float) -> Time:
    """Seconds since the epoch as a Time."""
    whole = math.floor(seconds)
    nanosec = round((seconds - whole) * 1e9)
    return Time(sec=int(whole) + nanosec // 1_000_000_000, nanosec=nanosec % 1_000_000_000)


def time_from_msg(msg: Time) -> float:
    """A Time as seconds."""
    return msg.sec + msg.nanosec * 1e-9


def duration_to_msg(seconds: float) -> Duration:
    """Seconds as a Duration."""
    t = time_to_msg(seconds)
    return Duration(sec=t.sec, nanosec=t.nanosec)


def header(frame_id: str, stamp: float = 0.0) -> Header:
    """A header of a frame and a stamp in seconds."""
    return Header(stamp=time_to_msg(stamp), frame_id=frame_id)


# ---------------------------------------------------------------- poses


def pose_to_msg(transform: NDArray[np.float64]) -> Pose:
    """4x4 transform to Pose."""
    x, y, z = (float(v) for v in transform[:3, 3])
    qx, qy, qz, qw = (float(v) for v in transforms.quaternion_xyzw(transform))
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_from_msg(msg: Pose) -> NDArray[np.float64]:
    """Pose to 4x4 transform; raises BAD_REQUEST for a quaternion that is not one."""
    p, q = msg.position, msg.orientation
    return _transform([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def transform_to_msg(transform: NDArray[np.float64]) -> Transform:
    """4x4 transform to Transform."""
    pose = pose_to_msg(transform)
    return Transform(translation=Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z), rotation=pose.orientation)


def transforms_to_msgs(stack: NDArray[np.float64]) -> list[Transform]:
    """Transforms (N, 4, 4) to messages, as :func:`transform_to_msg` makes each."""
    if not len(stack):
        return []
    return [
        Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(stack[:, :3, 3].tolist(), transforms.quaternion_xyzw(stack).tolist(), strict=True)
    ]


def transform_from_msg(msg: Transform) -> NDArray[np.float64]:
    """Transform to 4x4 transform; raises BAD_REQUEST for a quaternion that is not one."""
    t, q = msg.translation, msg.rotation
    return _transform([t.x, t.y, t.z], [q.x, q.y, q.z, q.w])


def transforms_from_msgs(msgs: Sequence[Transform]) -> NDArray[np.float64]:
    """Transforms to (N, 4, 4); raises BAD_REQUEST for the first whose quaternion is not one."""
    rows = [(*_XYZ(msg.translation), *_XYZW(msg.rotation)) for msg in msgs]
    try:
        return transforms.from_rows(np.array(rows, dtype=float).reshape(-1, 7))
    except ValueError:
        return np.stack([_transform(list(row[:3]), list(row[3:])) for row in rows])


def remember_transform(buffer: TransformBuffer, msg: TransformStamped, static: bool) -> None:
    """Put one TransformStamped into the buffer; raises NO_TRANSFORM, which the buffer remembers, for what is not one."""
    try:
        pose = transform_from_msg(msg.transform)
        buffer.set(msg.header.frame_id, msg.child_frame_id, pose, time_from_msg(msg.header.stamp), static)
    except MagicError as error:
        why = f"transform {msg.header.frame_id} -> {msg.child_frame_id}: {error.message}"
        buffer.refuse(msg.child_frame_id, why)
        raise MagicError(Code.NO_TRANSFORM, why) from error


def _transform(translation: list[float], xyzw: list[float]) -> NDArray[np.float64]:
    try:
        return transforms.from_numbers([*translation, *xyzw])
    except ValueError as error:
        raise MagicError(Code.BAD_REQUEST, "pose", f"position {translation}, orientation {xyzw}", str(error)) from None


# ---------------------------------------------------------------- images

_FORMATS: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "16UC1": ("u2", 1),
    "mono16": ("u2", 1),
    "32FC1": ("f4", 1),
}


def image_to_msg(array: NDArray, encoding: str, header: Header | None = None) -> Image:
    """An (H, W) or (H, W, C) array as an Image of that encoding; bool masks become 0 and 255."""
    dtype, channels = _FORMATS[encoding]
    if array.dtype == np.bool_:
        array = array.astype(np.uint8) * 255
    data = np.ascontiguousarray(array, dtype="<" + dtype)
    height, width = data.shape[:2]
    msg = Image(height=height, width=width, encoding=encoding, is_bigendian=0, step=width * channels * data.dtype.itemsize)
    msg.header = header or Header()
    msg.data.frombytes(data.tobytes())
    return msg


def _pixels(msg: Image, allowed: tuple[str, ...], code: Code) -> NDArray:
    if msg.encoding not in allowed:
        raise MagicError(Code.BAD_ENCODING, "image encoding", msg.encoding, allowed)
    dtype, channels = _FORMATS[msg.encoding]
    itemsize = np.dtype(dtype).itemsize
    row = msg.width * channels * itemsize
    if msg.width < 1 or msg.height < 1:
        raise MagicError(code, "image size", f"{msg.width} x {msg.height}", "at least 1 x 1")
    if msg.step < row or len(msg.data) != msg.step * msg.height:
        raise MagicError(
            code,
            "image step and data length",
            f"{msg.step} and {len(msg.data)} bytes",
            f"step >= {row} and step * {msg.height} bytes for {msg.width} x {msg.height} {msg.encoding}",
        )
    raw = np.frombuffer(msg.data, dtype=np.uint8).reshape(msg.height, msg.step)[:, :row]
    order = ">" if msg.is_bigendian else "<"
    pixels = np.ascontiguousarray(raw).view(order + dtype).reshape(msg.height, msg.width, channels)
    return pixels.astype(pixels.dtype.newbyteorder("="), copy=True)


def color_from_msg(msg: Image, code: Code = Code.BAD_IMAGE) -> NDArray[np.uint8]:
    """A colour Image (rgb8, bgr8, rgba8, bgra8, mono8) as (H, W, 3) uint8 RGB."""
    pixels = _pixels(msg, ("rgb8", "bgr8", "rgba8", "bgra8", "mono8"), code)
    if msg.encoding == "mono8":
        return np.repeat(pixels, 3, axis=2)
    pixels = pixels[:, :, :3]
    return np.ascontiguousarray(pixels[:, :, ::-1] if msg.encoding.startswith("bgr") else pixels)


def depth_from_msg(msg: Image, unit: str = "") -> NDArray[np.float32]:
    """A depth Image as (H, W) float32 metres, NaN where there is none (see :func:`magic_core.depth.in_metres`).

    unit: empty for REP-118's, millimetres in 16UC1 and metres in 32FC1.
    """
    return depths.in_metres(_pixels(msg, ("16UC1", "mono16", "32FC1"), Code.BAD_IMAGE)[:, :, 0], unit)


#: Bytes before the image of a compressedDepth message: int32 how, float32 A and B of depth = A /
#: (value - B) where depth was floating point.
_DEPTH_HEADER = 12


def color_from_compressed_msg(msg: CompressedImage) -> NDArray[np.uint8]:
    """A JPEG or PNG image as image_transport's ``compressed`` sends it, as (H, W, 3) uint8 RGB, in the camera's own orientation.

    ``format`` is ``jpeg`` or ``png``, or ``ENCODING; jpeg compressed ORDER``: what was given to the encoder as if it were BGR.
    """
    image = _decoded(msg, bytes(msg.data), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    encoding, _, how = msg.format.partition(";")
    order = how.partition("compressed")[2].strip() or (encoding if how else "")
    return np.ascontiguousarray(image if order.startswith("rgb") else image[..., ::-1])


def depth_from_compressed_msg(msg: CompressedImage, unit: str = "") -> NDArray[np.float32]:
    """A depth image as image_transport's ``compressedDepth`` sends it (PNG), or its ``compressed`` as 16-bit
    PNG, as :func:`depth_from_msg` gives it.

    ``format`` is ``16UC1; compressedDepth png``, the same with 32FC1, or ``16UC1; png compressed``;
    raises BAD_ENCODING for others (``rvl``).
    """
    encoding, _, how = (part.strip() for part in msg.format.partition(";"))
    with_header = how in ("compressedDepth", "compressedDepth png") and encoding in ("16UC1", "32FC1")
    if not with_header and not (encoding in ("16UC1", "mono16") and how.startswith("png compressed")):
        raise MagicError(
            Code.BAD_ENCODING,
            "format of compressed depth",
            msg.format,
            ("16UC1; compressedDepth png", "32FC1; compressedDepth png", "16UC1; png compressed"),
        )
    data = bytes(msg.data)
    raw = _decoded(msg, data[_DEPTH_HEADER if with_header else 0 :], cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise MagicError(Code.BAD_IMAGE, "compressed depth", f"{raw.shape} {raw.dtype}", "one channel of 16 bits")
    if encoding == "32FC1":
        _, a, b = struct.unpack("<iff", data[:_DEPTH_HEADER])
        with np.errstate(divide="ignore", invalid="ignore"):
            raw = np.where(raw > 0, np.float32(a) / (raw.astype(np.float32) - np.float32(b)), np.float32(np.nan))
    return depths.in_metres(raw, unit)


def _decoded(msg: CompressedImage, data: bytes, flags: int) -> NDArray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise MagicError(Code.BAD_IMAGE, "compressed image", f"{len(msg.data)} bytes of format {msg.format!r}", "a whole JPEG or PNG image")
    return image


def float_image_from_msg(msg: Image) -> NDArray[np.float32]:
    """A 32FC1 Image as it is, (H, W) float32."""
    return _pixels(msg, ("32FC1",), Code.BAD_IMAGE)[:, :, 0]


def mask_from_msg(msg: Image, code: Code = Code.BAD_IMAGE) -> NDArray[np.bool_]:
    """A mono8 Image as (H, W) bool: above 127 is inside."""
    return _pixels(msg, ("mono8", "8UC1"), code)[:, :, 0] > 127


def intrinsics_to_msg(intrinsics: Intrinsics, header: Header | None = None) -> CameraInfo:
    """Intrinsics as a CameraInfo without distortion."""
    k = intrinsics
    return CameraInfo(
        header=header or Header(),
        width=k.width,
        height=k.height,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=[float(x) for x in k.matrix.ravel()],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[k.fx, 0.0, k.cx, 0.0, 0.0, k.fy, k.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def intrinsics_from_msg(msg: CameraInfo) -> Intrinsics:
    """CameraInfo as intrinsics; raises BAD_INTRINSICS for sizes or focal lengths of zero."""
    return Intrinsics(int(msg.width), int(msg.height), float(msg.k[0]), float(msg.k[4]), float(msg.k[2]), float(msg.k[5]))


# ---------------------------------------------------------------- geometry

#: Triangles, and vertices, of one object's mesh and pieces together that are taken; more are refused unread.  rclpy makes a Python
#: object of each before any code of ours runs: 5 us each, half of it in the sender.
MOST_TRIANGLES = 1_000_000


#: Thousands of points and triangles are read at a time: this is twice as quick as naming the fields in a loop of Python's.
_XYZ, _XYZW, _CORNERS = attrgetter("x", "y", "z"), attrgetter("x", "y", "z", "w"), attrgetter("vertex_indices")


def mesh_to_msg(mesh: Mesh) -> MeshMsg:
    """Mesh to shape_msgs/Mesh (colours are left out)."""
    msg = MeshMsg()
    msg.vertices = [Point(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()]
    msg.triangles = [MeshTriangle(vertex_indices=face) for face in mesh.faces.astype(np.uint32)]
    return msg


def mesh_from_msg(msg: MeshMsg, colors: NDArray[np.uint8] | None = None) -> Mesh:
    """shape_msgs/Mesh to Mesh; raises BAD_MESH for indices out of range."""
    vertices = np.array(list(map(_XYZ, msg.vertices)), dtype=float).reshape(-1, 3)
    indices = list(map(_CORNERS, msg.triangles))
    faces = np.concatenate(indices).astype(np.int64).reshape(-1, 3) if indices else np.zeros((0, 3), np.int64)
    return Mesh(vertices, faces, colors)


def cloud_to_msg(points: NDArray[np.float64], colors: NDArray[np.uint8], header: Header) -> PointCloud2:
    """Points (N, 3) with colours (N, 3) uint8 as a PointCloud2 of x, y, z, rgb."""
    data = np.zeros(len(points), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    for axis, name in enumerate("xyz"):
        data[name] = points[:, axis]
    if len(colors) == len(points):
        c = colors.astype(np.uint32)
        data["rgb"] = (c[:, 0] << 16) | (c[:, 1] << 8) | c[:, 2]
    msg = PointCloud2(
        header=header, height=1, width=len(points), is_bigendian=False, point_step=16, row_step=16 * len(points), is_dense=True
    )
    msg.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32 if i < 3 else PointField.UINT32, count=1)
        for i, name in enumerate(("x", "y", "z", "rgb"))
    ]
    msg.data.frombytes(data.tobytes())
    return msg


def cloud_from_msg(msg: PointCloud2) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """The clouds that :func:`cloud_to_msg` makes: points (N, 3) and colours (N, 3)."""
    if msg.point_step != 16 or len(msg.data) != msg.row_step * msg.height:
        if msg.width * msg.height == 0:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        raise MagicError(Code.BAD_IMAGE, "point cloud step", msg.point_step, "16 bytes: x, y, z, rgb")
    raw = np.frombuffer(msg.data, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rgb = raw["rgb"]
    points = np.column_stack([raw["x"], raw["y"], raw["z"]]).astype(float)
    return points, np.column_stack([rgb >> 16 & 255, rgb >> 8 & 255, rgb & 255]).astype(np.uint8)


def frame_to_msgs(frame: RgbdFrame) -> dict[str, Image | CameraInfo]:
    """One frame as the RealSense driver publishes it with ``align_depth``: the topics below the camera's name, each with its message.

    The frame is CAMERA_color_optical_frame, depth 16UC1 in millimetres, 0 where there is none.
    """
    head = header(f"{frame.camera}_color_optical_frame", frame.stamp)
    millimetres = np.where(np.isfinite(frame.depth), np.round(np.nan_to_num(frame.depth) * 1000), 0).clip(0, 65535).astype(np.uint16)
    info = intrinsics_to_msg(frame.intrinsics, head)
    return {
        "color/camera_info": info,
        "color/image_raw": image_to_msg(frame.color, "rgb8", head),
        "aligned_depth_to_color/camera_info": info,
        "aligned_depth_to_color/image_raw": image_to_msg(millimetres, "16UC1", head),
    }


# ---------------------------------------------------------------- scene


def view_to_msg(view: CanonicalView) -> mi.CanonicalView:
    """CanonicalView to its message."""
    msg = mi.CanonicalView(kind=view.kind, metres_per_pixel=float(view.metres_per_pixel), confidence=float(view.confidence))
    msg.image = image_to_msg(view.image, "rgb8")
    msg.mask = image_to_msg(view.mask, "mono8")
    if view.depth is not None:
        msg.depth = image_to_msg(view.depth, "32FC1")
    msg.object_from_view = pose_to_msg(view.object_from_view)
    return msg


def view_from_msg(msg: mi.CanonicalView) -> CanonicalView:
    """Message to CanonicalView; raises BAD_REQUEST_IMAGE where sizes disagree."""
    image = color_from_msg(msg.image, Code.BAD_REQUEST_IMAGE)
    mask = mask_from_msg(msg.mask, Code.BAD_REQUEST_IMAGE)
    depth = float_image_from_msg(msg.depth) if len(msg.depth.data) else None
    if depth is not None and depth.shape != mask.shape:
        raise MagicError(Code.BAD_REQUEST_IMAGE, "depth of the view", depth.shape, mask.shape)
    return CanonicalView(
        image, mask, float(msg.metres_per_pixel), pose_from_msg(msg.object_from_view), msg.kind, depth, float(msg.confidence)
    )


def object_to_msg(item: SceneObject, header: Header) -> mi.SceneObject:
    """SceneObject to its message; ``header`` is that of the array it goes into."""
    msg = mi.SceneObject(id=item.id, source=item.source, camera=item.camera, confidence=float(item.confidence))
    msg.seen_share, msg.surface_error = float(item.seen_share), float(item.surface_error)
    msg.cut_off = list(item.cut_off)
    msg.hanging = item.hanging
    msg.pose = pose_to_msg(item.world_from_object)
    msg.mesh = mesh_to_msg(item.mesh)
    msg.pieces = [mesh_to_msg(piece) for piece in item.pieces]
    if item.mesh.colors is not None:
        msg.mesh_colors.frombytes(item.mesh.colors.tobytes())
    msg.box_pose = pose_to_msg(item.world_from_box)
    msg.box_size = Vector3(**dict(zip("xyz", (float(x) for x in item.box_extents), strict=True)))
    msg.view = view_to_msg(item.view)
    msg.cloud = cloud_to_msg(item.points, item.colors, header)
    if item.mask is not None:
        msg.mask = image_to_msg(item.mask, "mono8")
    if item.picture is not None:
        msg.picture = image_to_msg(item.picture, "rgb8")
    return msg


#: The view of an object for those who need none.
_NO_VIEW = CanonicalView(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), bool), 1.0, np.eye(4))


def object_from_msg(msg: mi.SceneObject, pictures: bool = True) -> SceneObject:
    """Message to SceneObject; raises BAD_MESH where there is more of it than MOST_TRIANGLES.

    pictures: false leaves view, mask and picture out, whether they came or not (a blank view).
    """
    for what in ("triangles", "vertices"):
        count = sum(len(getattr(mesh, what)) for mesh in (msg.mesh, *msg.pieces))
        if count > MOST_TRIANGLES:
            raise MagicError(Code.BAD_MESH, f"{what} of {msg.id}", count, f"up to {MOST_TRIANGLES}; thin the mesh out")
    colors = None
    if len(msg.mesh_colors):
        if len(msg.mesh_colors) != 3 * len(msg.mesh.vertices):
            raise MagicError(
                Code.BAD_MESH, f"mesh_colors of {msg.id}", len(msg.mesh_colors), f"{3 * len(msg.mesh.vertices)} bytes, RGB for each vertex"
            )
        colors = np.array(msg.mesh_colors, dtype=np.uint8).reshape(-1, 3)
    points, point_colors = cloud_from_msg(msg.cloud)
    return SceneObject(
        id=msg.id,
        mesh=mesh_from_msg(msg.mesh, colors),
        pieces=tuple(mesh_from_msg(piece) for piece in msg.pieces),
        world_from_object=pose_from_msg(msg.pose),
        view=view_from_msg(msg.view) if pictures else _NO_VIEW,
        points=points,
        colors=point_colors,
        mask=mask_from_msg(msg.mask) if pictures and len(msg.mask.data) else None,
        camera=msg.camera,
        picture=color_from_msg(msg.picture, Code.BAD_REQUEST_IMAGE) if pictures and len(msg.picture.data) else None,
        world_from_box=pose_from_msg(msg.box_pose),
        box_extents=np.array([msg.box_size.x, msg.box_size.y, msg.box_size.z]),
        confidence=float(msg.confidence),
        source=msg.source,
        seen_share=float(msg.seen_share),
        cut_off=tuple(msg.cut_off),
        hanging=msg.hanging,
        surface_error=float(msg.surface_error),
    )


def without_pictures(msg: mi.SceneObject, cloud: bool, surface: bool) -> mi.SceneObject:
    """What planner and verifier need of an object's message: view, mask and picture left out, and without ``cloud`` its points, without
    ``surface`` its mesh, where convex pieces say the same.  Nothing is copied."""
    light = copy.copy(msg)
    light.view, light.mask, light.picture = mi.CanonicalView(), Image(), Image()
    if not cloud:
        light.cloud = PointCloud2(header=msg.cloud.header)
    if not surface and any(piece.vertices for piece in msg.pieces):
        light.mesh = MeshMsg()
        light.mesh_colors = type(msg.mesh_colors)("B")
    return light


def plane_to_msg(plane: NDArray[np.float64]) -> Plane:
    """(4,) plane coefficients to Plane."""
    return Plane(coef=[float(x) for x in plane])


def plane_from_msg(msg: Plane) -> NDArray[np.float64]:
    """Plane to (4,) coefficients with a unit normal that points up; all zeros mean the plane z = 0."""
    coef = np.array(msg.coef, dtype=float)
    norm = float(np.linalg.norm(coef[:3]))
    if not (np.all(np.isfinite(coef)) and np.isfinite(norm)):
        raise MagicError(Code.BAD_REQUEST, "coefficients of the plane", coef.tolist(), "finite numbers a, b, c, d of ax + by + cz + d = 0")
    if norm < 1e-9:
        return np.array([0.0, 0.0, 1.0, 0.0])
    coef /= norm
    return coef if coef[2] >= 0 else -coef


def scene_to_msg(scene: Scene) -> mi.SceneObjectArray:
    """Scene to SceneObjectArray."""
    head = header(scene.frame_id, scene.stamp)
    return mi.SceneObjectArray(
        header=head,
        objects=[object_to_msg(item, head) for item in scene.objects],
        table=plane_to_msg(scene.table),
        camera_offset=float(scene.camera_offset),
        camera_angle=float(scene.camera_angle),
        notes=list(scene.notes),
    )


def scene_from_msg(msg: mi.SceneObjectArray) -> Scene:
    """SceneObjectArray to Scene."""
    return Scene(
        tuple(object_from_msg(item) for item in msg.objects),
        plane_from_msg(msg.table),
        time_from_msg(msg.header.stamp),
        msg.header.frame_id,
        float(msg.camera_offset),
        float(msg.camera_angle),
        tuple(msg.notes),
    )


def check_frames(base: str, objects: Iterable[mi.SceneObject], *trajectories: JointTrajectory | MultiDOFJointTrajectory) -> None:
    """Refuse objects and trajectories in another frame than the robot's base, whose name is ``base``; raises BAD_REQUEST naming both.

    An object's frame is that of its cloud, the array's.  An empty name means the base frame.
    """
    named = [(f"object {o.id}", o.cloud.header.frame_id) for o in objects]
    named += [(f"the trajectory of {', '.join(t.joint_names)}", t.header.frame_id) for t in trajectories if t.points]
    for what, frame in named:
        if frame.lstrip("/") not in ("", base):
            raise MagicError(Code.BAD_REQUEST, f"frame of {what}", frame, f"{base}, the robot's base frame")


def carried(msg: mi.SceneObjectArray, frame_id: str, frame_from_own: NDArray[np.float64]) -> mi.SceneObjectArray:
    """A scene told in another frame: poses, boxes, clouds and table moved by (4, 4) ``frame_from_own``; the rest is shared, not copied."""

    def moved(pose: Pose) -> Pose:
        return pose_to_msg(frame_from_own @ pose_from_msg(pose))

    table = plane_from_msg(msg.table)
    normal = frame_from_own[:3, :3] @ table[:3]
    result = copy.copy(msg)
    result.header = Header(stamp=msg.header.stamp, frame_id=frame_id)
    result.table = plane_to_msg(np.array([*normal, table[3] - normal @ frame_from_own[:3, 3]]))
    result.objects = []
    for item in msg.objects:
        own = copy.copy(item)
        own.pose, own.box_pose = moved(item.pose), moved(item.box_pose)
        points, colors = cloud_from_msg(item.cloud)
        own.cloud = cloud_to_msg(transforms.apply(frame_from_own, points), colors, Header(stamp=item.cloud.header.stamp, frame_id=frame_id))
        result.objects.append(own)
    return result


# ---------------------------------------------------------------- contacts


def contact_to_msg(contact: Contact) -> mi.Contact:
    """Contact to its message."""
    msg = mi.Contact(
        pixel=np.asarray(contact.pixel, dtype=float),
        normal=np.asarray(contact.normal, dtype=float),
        radius=float(contact.radius),
        concave=bool(contact.concave),
        scale=float(contact.scale),
        object_from_contact=pose_to_msg(contact.object_from_contact),
        has_surface=contact.surface is not None,
    )
    if contact.surface is not None:
        msg.object_from_surface = pose_to_msg(contact.surface.object_from_surface)
        msg.curvatures = np.asarray(contact.surface.curvatures, dtype=float)
        msg.reach, msg.residue = float(contact.surface.reach), float(contact.surface.residue)
    return msg


def contact_from_msg(msg: mi.Contact) -> Contact:
    """Message to Contact."""
    surface = None
    if msg.has_surface:
        frame = pose_from_msg(msg.object_from_surface)
        surface = PrincipalFrame(frame, np.array(msg.curvatures), float(msg.reach), float(msg.residue))
    return Contact(
        np.array(msg.pixel),
        np.array(msg.normal),
        float(msg.radius),
        bool(msg.concave),
        float(msg.scale),
        pose_from_msg(msg.object_from_contact),
        surface,
    )


def companion_to_msg(companion: Companion) -> mi.FurtherContact:
    """Companion to its message."""
    msg = mi.FurtherContact(name=companion.name, tool=contact_to_msg(companion.tool), has_target=companion.target is not None)
    if companion.target is not None:
        msg.target = contact_to_msg(companion.target)
    return msg


def companion_from_msg(msg: mi.FurtherContact) -> Companion:
    """Message to Companion."""
    return Companion(msg.name, contact_from_msg(msg.tool), contact_from_msg(msg.target) if msg.has_target else None)


def candidate_to_msg(candidate: ContactCandidate, world_from_tool: NDArray[np.float64] | None = None) -> mi.ContactCandidate:
    """ContactCandidate to its message; ``world_from_tool`` fills in the 3D point."""
    point = [math.nan] * 3
    if world_from_tool is not None:
        point = [float(x) for x in (world_from_tool @ candidate.tool.object_from_contact)[:3, 3]]
    msg = mi.ContactCandidate(
        tool_id=candidate.tool_id,
        tool=contact_to_msg(candidate.tool),
        has_target=candidate.target is not None,
        point=Point(x=point[0], y=point[1], z=point[2]),
        rotation=float(candidate.rotation),
        turn=float(candidate.turn),
        flipped=bool(candidate.flipped),
        s_dino=float(candidate.s_dino),
        s_curv=float(candidate.s_curv),
        score=float(candidate.score),
        tool_from_reference=pose_to_msg(candidate.tool_from_reference),
        companions=[companion_to_msg(companion) for companion in candidate.companions],
    )
    if candidate.target is not None:
        msg.target = contact_to_msg(candidate.target)
    return msg


def candidate_from_msg(msg: mi.ContactCandidate) -> ContactCandidate:
    """Message to ContactCandidate."""
    return ContactCandidate(
        tool_id=msg.tool_id,
        tool=contact_from_msg(msg.tool),
        target=contact_from_msg(msg.target) if msg.has_target else None,
        rotation=float(msg.rotation),
        flipped=bool(msg.flipped),
        s_dino=float(msg.s_dino),
        s_curv=float(msg.s_curv),
        score=float(msg.score),
        tool_from_reference=pose_from_msg(msg.tool_from_reference),
        companions=tuple(companion_from_msg(companion) for companion in msg.companions),
        turn=float(msg.turn),
    )


# ---------------------------------------------------------------- motions


def tool_motion_to_msg(motion: ToolMotion, tool_id: str, frame_id: str = "panda_link0") -> MultiDOFJointTrajectory:
    """ToolMotion to a MultiDOFJointTrajectory with the tool's id as its one joint name."""
    return MultiDOFJointTrajectory(
        header=header(frame_id),
        joint_names=[tool_id],
        points=[
            MultiDOFJointTrajectoryPoint(transforms=[transform], time_from_start=duration_to_msg(float(t)))
            for t, transform in zip(motion.times, transforms_to_msgs(motion.world_from_tool), strict=True)
        ],
    )


def arm_motion_to_msg(motion: ArmMotion, frame_id: str = "panda_link0") -> JointTrajectory:
    """The joint part of an ArmMotion as a JointTrajectory."""
    return JointTrajectory(
        header=header(frame_id),
        joint_names=list(motion.joint_names),
        points=[
            JointTrajectoryPoint(positions=p, velocities=v, accelerations=a, time_from_start=duration_to_msg(t))
            for t, p, v, a in zip(
                motion.times.tolist(), motion.positions.tolist(), motion.velocities.tolist(), motion.accelerations.tolist(), strict=True
            )
        ],
    )


def plan_to_msg(plan: MotionPlan, tool_id: str, frame_id: str = "panda_link0") -> mi.MotionPlan:
    """MotionPlan to its message."""
    arm = plan.arm_motion
    phases = arm.phases if arm is not None and arm.phases else plan.tool_motion.phases
    msg = mi.MotionPlan(variant=plan.variant, release_time=math.nan)
    msg.tool_trajectory = tool_motion_to_msg(plan.tool_motion, tool_id, frame_id)
    msg.phases = [mi.MotionPhase(name=p.name, start=float(p.start), end=float(p.end)) for p in phases]
    if arm is not None:
        msg.arm_trajectory = arm_motion_to_msg(arm, frame_id)
        msg.tool_from_tcp = pose_to_msg(arm.tool_from_tcp)
        msg.grasp_width = float(arm.grasp_width)
        msg.grasp_time = float(arm.grasp_time)
        msg.release_time = math.nan if arm.release_time is None else float(arm.release_time)
    return msg


def plan_from_msg(msg: mi.MotionPlan) -> MotionPlan:
    """Message to MotionPlan; raises BAD_MOTION or UNKNOWN_VARIANT for what is not one."""

    def seconds(d: Duration) -> float:
        return d.sec + d.nanosec * 1e-9

    points = msg.tool_trajectory.points
    if any(len(p.transforms) != 1 for p in points):
        raise MagicError(Code.BAD_MOTION, "tool trajectory", "a point without exactly one transform", "one transform for each point")
    phases = tuple(Phase(p.name, p.start, p.end) for p in msg.phases)
    motion = ToolMotion(
        np.array([seconds(p.time_from_start) for p in points]),
        transforms_from_msgs([p.transforms[0] for p in points]),
        phases,
    )
    arm = None
    if msg.variant == mi.MotionPlan.ARM:
        names = tuple(msg.arm_trajectory.joint_names)
        rows = msg.arm_trajectory.points
        if not rows or any(not len(p.positions) == len(p.velocities) == len(p.accelerations) == len(names) for p in rows):
            raise MagicError(
                Code.BAD_MOTION,
                "arm trajectory",
                f"{len(rows)} points",
                f"points with {len(names)} positions, velocities and accelerations each",
            )
        arm = ArmMotion(
            times=np.array([seconds(p.time_from_start) for p in rows]),
            joint_names=names,
            positions=np.array([p.positions for p in rows]),
            velocities=np.array([p.velocities for p in rows]),
            accelerations=np.array([p.accelerations for p in rows]),
            tool_from_tcp=pose_from_msg(msg.tool_from_tcp),
            grasp_width=float(msg.grasp_width),
            grasp_time=float(msg.grasp_time),
            release_time=None if math.isnan(msg.release_time) else float(msg.release_time),
            phases=phases,
        )
    return MotionPlan(msg.variant, motion, arm)
