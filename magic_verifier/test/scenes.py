"""Small scenes of boxes, rings and bowls for the tests, with motions written out by hand."""

from __future__ import annotations

import numpy as np
import trimesh

from magic_core import transforms
from magic_core.contact import Contact
from magic_core.mesh import Mesh, concatenate, from_trimesh
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.scene import CanonicalView
from magic_core.strategy import Goal, Physics, Strategy
from magic_verifier.floating import as_object

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


def block(x, y, z):
    """A box from its ranges."""
    corners = np.array([[a, b, c] for a in x for b in y for c in z], dtype=float)
    return hull(corners)


def hull(points):
    return from_trimesh(trimesh.convex.convex_hull(np.asarray(points, dtype=float)))


def standing_cylinder(radius, sections=48):
    return from_trimesh(trimesh.creation.cylinder(radius, 2 * radius, sections=sections))


def item(name, parts, pose=None):
    parts = tuple(parts)
    mesh = concatenate([Mesh(p.vertices, p.faces) for p in parts])
    return as_object(name, mesh, parts, np.eye(4) if pose is None else pose)


def strategy(test, values=None, physics=None, normal=(1.0, 0.0, 0.0), releases=False, simulatable=True):
    view = CanonicalView(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), bool), 1.0, np.eye(4))
    contact = Contact(np.zeros(2), np.array([1.0, 0.0]), 0.02, True, 0.02, np.eye(4))
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3)))
    return Strategy(
        "test", "", "top", "plan", view, contact, view, contact, np.array(normal), np.array([0, 0, -1.0]), np.zeros(1), np.eye(4)[None],
        nothing, nothing, (), Goal(test, dict(values or {})), physics or Physics(), releases=releases, simulatable=simulatable,
    )  # fmt: skip


def plan(poses):
    """A floating plan through (world_from_tool, phase, seconds); the first one only says where it starts."""
    times, knots, phases = [0.0], [poses[0][0]], []
    for pose, name, seconds in poses[1:]:
        phases.append(Phase(name, times[-1], times[-1] + seconds))
        times.append(times[-1] + seconds)
        knots.append(pose)
    at = np.append(np.arange(0.0, times[-1] - 1e-6, 0.01), times[-1])
    return MotionPlan("fg", ToolMotion(at, transforms.interpolate(times, np.stack(knots), at), tuple(phases)))


def hooking(kind, radius=0.025, noise=1.0, friction=0.5):
    """Strategy, tool, target and plan of a pull by 0.28 m; ``kind``: an L hook or a straight bar that reaches half over the target."""
    low, high = 0.001, 0.03
    side = -radius - 0.002
    if kind == "L":
        parts = [block((0, 0.02), (side - 0.02, 2.2 * radius), (low, high)), block((-0.3, 0.02), (side - 0.02, side), (low, high))]
    else:
        parts = [block((0, 0.02), (0.3 * radius, 0.3 * radius + 0.2), (low, high))]
    target = item("target", [standing_cylinder(radius)], transforms.make(translation=[0.6, 0, radius]))

    def at(x, z=0.0):
        return transforms.make(translation=[0.6 + radius + x, 0, z])

    motion = plan(
        [
            (at(0.03, 0.1), "", 0),
            (at(0.03), "approach", 0.7),
            (at(0.0), "contact", 0.3),
            (at(-0.28), "goal", 2.8),
            (at(-0.26), "retreat", 0.2),
        ]
    )
    return strategy("hook", {"noise": noise}, Physics(friction, 600.0, 100.0)), item("tool", parts), target, motion


def ring(radius=0.03, width=0.008, thickness=0.012, count=24):
    parts = []
    for k in range(count):
        angles = (2 * np.pi * k / count, 2 * np.pi * (k + 1) / count)
        parts.append(
            hull(
                [
                    [(radius + s * width / 2) * np.cos(a), y, (radius + s * width / 2) * np.sin(a)]
                    for a in angles
                    for s in (-1, 1)
                    for y in (-thickness / 2, thickness / 2)
                ]
            )
        )
    return parts


def hanging(aside=0.0, lower=0.0):
    """A ring is slid on to a rod along y and let go; ``aside`` (m) misses the rod sideways, ``lower`` (m) goes into it."""
    rod = trimesh.creation.cylinder(0.006, 0.15, sections=24)
    rod.apply_transform(transforms.from_rpy(np.pi / 2, 0, 0, [0, 0.075, 0]))
    target = item("rod", [from_trimesh(rod)], transforms.make(translation=[0.5, 0, 0.4]))
    hung = np.array([0.5 + aside, 0.03, 0.4 + 0.006 - 0.026 + 0.0005 - lower])

    def at(y, z):
        return transforms.make(translation=hung + np.array([0, y, z]))

    motion = plan([(at(-0.1, 0.01), "", 0), (at(0, 0.01), "approach", 1.0), (at(0, 0), "contact", 0.3), (at(0, 0), "release", 0.1)])
    return (
        strategy("hang", {}, Physics(0.5, 600.0, 600.0, True), normal=(0.0, 0.0, 1.0), releases=True),
        item("tool", ring()),
        target,
        motion,
    )


def scooping(bowl_radius=0.05, ball_radius=0.035):
    """A bowl pushes a ball up a quarter pipe; also returns the pipe."""
    edge, thick, parts = np.radians(70), 0.004, []

    def on_bowl(r, polar, around):
        return -r * np.cos(polar), r * np.sin(polar) * np.cos(around), r * np.sin(polar) * np.sin(around)

    polars, arounds = np.linspace(0, edge, 5), np.linspace(0, 2 * np.pi, 13)
    for i in range(4):
        for j in range(12):
            parts.append(
                hull([on_bowl(r, p, a) for r in (bowl_radius, bowl_radius + thick) for p in polars[i : i + 2] for a in arounds[j : j + 2]])
            )
    rim, back = bowl_radius * np.sin(edge), -bowl_radius * np.cos(edge)
    parts.append(block((back - 0.006, back), (-0.008, 0.008), (rim, rim + 0.15)))
    foot, pipe = 0.45, []
    for k in range(24):
        angles = np.radians([90 * k / 24, 90 * (k + 1) / 24])
        pipe.append(hull([(foot + r * np.sin(a), y, 0.2 - r * np.cos(a)) for a in angles for r in (0.2, 0.22) for y in (-0.1, 0.1)]))
    ball = item(
        "ball", [from_trimesh(trimesh.creation.icosphere(3, ball_radius))], transforms.make(translation=[foot - 0.1, 0, ball_radius])
    )
    start = transforms.make(translation=[foot - 0.16, 0, rim + 0.012])
    turned = transforms.make(translation=[0.15, 0, 0]) @ start
    about = np.array([foot, 0, 0.2])
    poses = [(start, "", 0), (transforms.make(translation=[0.06, 0, 0]) @ start, "contact", 0.6), (turned, "goal", 0.9)]
    for k in range(1, 31):
        turn = transforms.make(translation=about) @ transforms.from_rpy(0, -np.pi / 2 * k / 30, 0) @ transforms.make(translation=-about)
        poses.append((turn @ turned, "goal", 0.1))
    poses.append((transforms.make(translation=[0, 0, 0.05]) @ poses[-1][0], "goal", 0.5))
    motion = plan(poses)
    return strategy("scoop", {}, Physics(0.1, 300.0, 100.0), normal=(-1.0, 0.0, 0.0)), item("tool", parts), ball, item("arc", pipe), motion
