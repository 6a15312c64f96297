"""Messages that only perception knows: markers, diagnostics.  Everything else is in :mod:`magic_core.conversions`."""

from __future__ import annotations

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Vector3
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magic_core import conversions as cv
from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code
from magic_core.scene import Scene

#: Distinct colours for objects, RGB 0..1.
PALETTE = ((0.90, 0.35, 0.25), (0.25, 0.60, 0.90), (0.30, 0.75, 0.35), (0.95, 0.75, 0.20), (0.65, 0.40, 0.85), (0.25, 0.80, 0.80))


#: OpenCV takes so many coefficients of a lens.
COEFFICIENTS = (4, 5, 8, 12, 14)


def distortion(info: CameraInfo, intrinsics: Intrinsics) -> float:
    """By how many pixels the lens moves what is at the edge of the picture, at most; 0 without coefficients, infinite where they are of no
    known model."""
    given = np.array(info.d, float)
    if not given.any():
        return 0.0
    if not np.isfinite(given).all() or len(given) not in COEFFICIENTS:
        return np.inf
    edge = np.linspace(0.0, 1.0, 9)
    u, v = (np.concatenate(sides) for sides in ((edge, edge, 0 * edge, 0 * edge + 1), (0 * edge, 0 * edge + 1, edge, edge)))
    straight = np.stack([u * (intrinsics.width - 1), v * (intrinsics.height - 1)], axis=-1)
    rays = np.concatenate([(straight - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy), np.ones((len(u), 1))], axis=1)
    still, k = np.zeros(3), intrinsics.matrix
    if info.distortion_model == "equidistant":
        bent, _ = cv2.fisheye.projectPoints(rays[:, None], still, still, k, given[:4])
    else:
        bent, _ = cv2.projectPoints(rays, still, still, k, given)
    return float(np.linalg.norm(bent.reshape(-1, 2) - straight, axis=1).max())


def markers(scene: Scene) -> MarkerArray:
    """A scene for RViz: DELETEALL, then for each object its mesh (``meshes``), its box (``boxes``) and its id (``names``); the table's
    height as a thin square (``table``)."""
    head = cv.header(scene.frame_id, scene.stamp)
    result = [Marker(header=head, action=Marker.DELETEALL)]

    def add(ns: str, index: int, kind: int, pose: np.ndarray, color: tuple[float, float, float], alpha: float) -> Marker:
        marker = Marker(header=head, ns=ns, id=index, type=kind, action=Marker.ADD, frame_locked=True)
        marker.pose = cv.pose_to_msg(pose)
        marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
        r, g, b = color
        marker.color = ColorRGBA(r=r, g=g, b=b, a=alpha)
        result.append(marker)
        return marker

    for i, item in enumerate(scene.objects):
        color = PALETTE[i % len(PALETTE)] if item.source == "camera" else (0.6, 0.6, 0.6)
        mesh = add("meshes", i, Marker.TRIANGLE_LIST, item.world_from_object, color, 0.9)
        # One Python object for each vertex, not for each corner of a triangle: making them is what takes the time.
        corners_of_faces = item.mesh.faces.ravel().tolist()
        points = [Point(x=x, y=y, z=z) for x, y, z in item.mesh.vertices.tolist()]
        mesh.points = [points[k] for k in corners_of_faces]
        if item.mesh.colors is not None:
            colors = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in (item.mesh.colors / 255.0).tolist()]
            mesh.colors = [colors[k] for k in corners_of_faces]
        if np.all(item.box_extents > 0):
            box = add("boxes", i, Marker.LINE_LIST, item.world_from_box, color, 1.0)
            box.scale = Vector3(x=0.0015, y=0.0, z=0.0)
            corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * item.box_extents
            for a in range(8):
                for bit in (1, 2, 4):
                    if not a & bit:
                        box.points += [Point(x=p[0], y=p[1], z=p[2]) for p in corners[[a, a | bit]].tolist()]
        top = item.world_from_object[2, 3] + float(item.mesh.extents[2]) / 2 if len(item.mesh.vertices) else item.world_from_object[2, 3]
        text = add(
            "names", i, Marker.TEXT_VIEW_FACING, transforms.make(None, [*item.world_from_object[:2, 3], top + 0.03]), (1.0, 1.0, 1.0), 1.0
        )
        text.scale.z = 0.025
        text.text = item.id
    return MarkerArray(markers=result)


def status(name: str, level: bytes, message: str, code: Code, values: dict[str, object]) -> DiagnosticStatus:
    """One diagnostic status; its values begin with the code's number and name."""
    pairs = {"code": int(code), "code_name": code.name, **values}
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id="", values=[KeyValue(key=k, value=str(v)) for k, v in pairs.items()]
    )
