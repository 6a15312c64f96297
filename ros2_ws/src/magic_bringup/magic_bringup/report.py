"""The report of a run: one HTML file that needs nothing else.

``demo.sh`` and ``magic run --out DIR`` write it; ``ros2 run magic_bringup report DIR`` draws it again from what they left in DIR.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from numpy.typing import NDArray

from magic_bringup.record import Record, empty_summary
from magic_core import conversions, transforms
from magic_core import strategy as strategies
from magic_core.camera import Intrinsics
from magic_core.contact import Contact
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView, Scene, SceneObject

Image = NDArray[np.uint8]

#: Colours of objects, in the order of the scene (a colour-blind safe palette, Okabe and Ito).
PALETTE = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167))
NORMAL, CIRCLE, POINT = (0, 200, 255), (255, 80, 200), (255, 40, 40)
PICTURE = 520

#: What the words of the page mean.
TERMS = (
    ("verified", "The lower end of the success rate's 95 % interval reached what the verifier asks for. Nothing else is published."),
    ("rollout", "One simulation of the motion, with what nobody knows drawn at random: friction, masses, places, shapes, the tool in the hand."),
    ("candidate", "One contact on one tool that may correspond to the demonstrated one, with the motion that follows from it."),
    ("contact, normal, circle", "Where tool and target touch; the direction out of the tool there; the circle of curvature of its outline there."),
    ("score", "global + 0.1 x local, by default: how well a candidate corresponds to the demonstrated contact."),
    ("global", "Likeness of the surroundings of the contact by features, at most 1."),
    ("local", "Likeness of the curvature at the contact, at most 1."),
    ("turn, face", "By how much the tool's view was turned, and whether it was mirrored, to look like the demonstration's. "
     "keep, turn: whether the tool keeps the side that lies up, or is turned over."),
    ("stage", "How far a candidate came: match, plan, verify."),
    ("fg, arm", "fg: a floating gripper moves the tool, without an arm. arm: the robot grasps the tool and moves it."),
    ("peak memory", "The most memory that a process held at any time."),
)  # fmt: skip

#: What the video of a run is called beside its messages.
VIDEO = "video.webp"
#: Rows and columns of the picture of the scene, pixels.
SCENE_PICTURE = (480, 720)

# ---------------------------------------------------------------- pictures


def data_uri(image: Image, quality: int = 0) -> str:
    """An RGB picture (H, W, 3) as a data URI; PNG, or JPEG of a quality above 0."""
    kind, parameters = ("jpg", [cv2.IMWRITE_JPEG_QUALITY, quality]) if quality else ("png", [cv2.IMWRITE_PNG_COMPRESSION, 6])
    ok, buffer = cv2.imencode("." + kind, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)
    if not ok:
        raise MagicError(Code.BAD_IMAGE, "picture for the report", image.shape)
    return f"data:image/{'jpeg' if quality else 'png'};base64,{base64.b64encode(buffer.tobytes()).decode()}"


def depth_picture(depth: NDArray[np.float32]) -> Image:
    """Depth (H, W) metres in colours between its 2nd and 98th percentile; black where there is none."""
    known = np.isfinite(depth)
    if not known.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[known], [2, 98])
    level = np.clip((np.nan_to_num(depth, nan=low) - low) / max(high - low, 1e-6), 0, 1)
    picture = cv2.cvtColor(cv2.applyColorMap((255 * (1 - level)).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    picture[~known] = 0
    return picture


def masks_picture(color: Image, masks: list[tuple[str, NDArray[np.bool_], tuple[int, int, int]]]) -> Image:
    """A colour image with objects tinted, outlined and named."""
    picture = color.copy()
    for name, mask, tint in masks:
        if mask.shape != color.shape[:2] or not mask.any():
            continue
        picture[mask] = (0.5 * picture[mask] + 0.5 * np.array(tint)).astype(np.uint8)
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outline, -1, tint, 2, cv2.LINE_AA)
        v, u = np.argwhere(mask).min(axis=0)
        place = (int(u), int(max(14, v - 6)))
        cv2.putText(picture, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def heat_picture(view: CanonicalView, heatmap: NDArray[np.float32]) -> Image:
    """A canonical view under its heat map (any size, 0..1), on the object only.

    A heat map that is known only along the contour is widened to a band of 2 % of the picture; the hottest place is white.
    """
    heat = cv2.resize(np.nan_to_num(heatmap.astype(np.float32)), view.mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    heat = heat / max(float(heat.max()), 1e-6)
    width = max(3, view.mask.shape[0] // 50 | 1)
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    heat = np.maximum(heat, cv2.GaussianBlur(cv2.dilate(heat, near), (0, 0), width / 4))
    # The square root shows the runners-up, too.
    colors = cv2.cvtColor(cv2.applyColorMap((255 * np.sqrt(np.clip(heat, 0, 1))).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    around = cv2.dilate(view.mask.astype(np.uint8), near).astype(bool)
    return np.where(around[..., None], np.maximum((0.4 * view.image).astype(np.uint8), colors), view.image)


def contact_picture(view: CanonicalView, contact: Contact, base: Image | None = None) -> Image:
    """A canonical view with the contact point, its outward normal (an arrow) and the circle of curvature."""
    scale = PICTURE / max(view.mask.shape)
    picture = cv2.resize(view.image if base is None else base, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    # The contact's place is taken from its frame, which holds in any view of the object along the same direction.
    frame = contact.object_from_contact
    at = (view.pixels(frame[:3, 3]) + 0.5) * scale - 0.5
    tip = view.pixels(frame[:3, 3] + 0.05 * frame[:3, 0]) - view.pixels(frame[:3, 3])
    normal = tip / max(float(np.linalg.norm(tip)), 1e-9)

    def fixed(point: NDArray[np.float64]) -> tuple[int, int]:
        return int(round(16 * point[0])), int(round(16 * point[1]))

    radius = contact.radius / view.metres_per_pixel * scale
    if np.isfinite(radius) and radius < 6 * PICTURE:
        center = at + (1 if contact.concave else -1) * radius * normal
        cv2.circle(picture, fixed(center), int(round(16 * radius)), CIRCLE, 2, cv2.LINE_AA, 4)
    else:
        tangent = PICTURE * np.array([-normal[1], normal[0]])
        cv2.line(picture, fixed(at - tangent), fixed(at + tangent), CIRCLE, 2, cv2.LINE_AA, 4)
    head = at + 46 * normal
    for start, end in (
        (at, head),
        (head, head - 12 * normal + 7 * normal[::-1] * [1, -1]),
        (head, head - 12 * normal - 7 * normal[::-1] * [1, -1]),
    ):
        cv2.line(picture, fixed(start), fixed(end), NORMAL, 2, cv2.LINE_AA, 4)
    cv2.circle(picture, fixed(at), 16 * 6, (255, 255, 255), -1, cv2.LINE_AA, 4)
    cv2.circle(picture, fixed(at), 16 * 4, POINT, -1, cv2.LINE_AA, 4)
    return picture


def look_at(eye: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_camera of an optical frame at ``eye`` that looks at ``point``, world z up in the picture."""
    z = transforms.unit(point - eye)
    x = transforms.unit(np.cross(z, [0.0, 0.0, 1.0]))
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), eye)


def scene_picture(scene: Scene, path: NDArray[np.float64] | None = None) -> Image:
    """The reconstructed objects on the table, ray-cast; ``path`` (N, 3) world metres is drawn over it."""
    from magic_core.rendering import Raycaster, shade

    meshes = []
    for index, item in enumerate(scene.objects):
        mesh = item.mesh.transformed(item.world_from_object)
        meshes.append(mesh if mesh.colors is not None and mesh.colors.any() else mesh.painted(PALETTE[index % len(PALETTE)]))
    points = np.concatenate([m.vertices for m in meshes] + ([path] if path is not None and len(path) else []))
    low, high = points.min(axis=0), points.max(axis=0)
    center, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.15)
    meshes.append(_table(scene.table, center, 1.2 * reach))
    # From the robot's right front: far enough that the sphere around everything fits a field of view of 40 degrees.
    world_from_camera = look_at(center + 1.35 * reach * transforms.unit([-0.75, -0.8, 0.85]), center)
    height, width = SCENE_PICTURE
    focal = height / 2 / np.tan(np.radians(20))
    intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    cast, _ = Raycaster(meshes).perspective(intrinsics, world_from_camera)
    picture = shade(cast, light=(-0.5, -0.3, 1.0), background=(236, 239, 244))
    if path is not None and len(path) > 1:
        pixels = intrinsics.project(transforms.apply(transforms.inverse(world_from_camera), path))
        pixels = pixels[np.all(np.isfinite(pixels), axis=1)]
        if len(pixels) > 1:
            cv2.polylines(picture, [np.round(16 * pixels).astype(np.int32)], False, (31, 95, 191), 2, cv2.LINE_AA, 4)
    return picture


def _table(plane: NDArray[np.float64], center: NDArray[np.float64], half: float) -> Mesh:
    a, b, c, d = (float(x) for x in plane)
    corners = []
    for x, y in ((-half, -half), (half, -half), (half, half), (-half, half)):
        px, py = center[0] + x, center[1] + y
        corners.append((px, py, -(a * px + b * py + d) / c - 1e-3))
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])).painted((214, 209, 200))


def target_view(item: SceneObject, strategy: strategies.Strategy) -> CanonicalView:
    """The target as the strategy looks at it: along its view direction, world z up (x up from above)."""
    from magic_core.rendering import canonical_view

    direction = strategy.target_view_direction
    up = np.array([1.0, 0.0, 0.0]) if abs(direction[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    object_from_world = transforms.inverse(item.world_from_object)[:3, :3]
    return canonical_view(item.mesh, object_from_world @ direction, object_from_world @ up, strategy.view)


def _figure_image(figure: Any) -> Image:
    figure.canvas.draw()
    return np.ascontiguousarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])


def _phases(axes: Any, phases: Any) -> None:
    for index, phase in enumerate(phases):
        axes.axvspan(phase.start, phase.end, color="#1f5fbf", alpha=0.05 if index % 2 else 0.11, lw=0)
        axes.text(
            (phase.start + phase.end) / 2,
            1.01,
            phase.name,
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="bottom",
            fontsize=8,
            rotation=25,
        )


def motion_picture(plan: Any) -> Image:
    """Joints (variant arm) or the tool's pose (fg) over time, with the phases named."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    arm = plan.arm_motion
    figure = Figure(figsize=(11, 6.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    if arm is not None:
        t = arm.times
        for j, name in enumerate(arm.joint_names):
            upper.plot(t, arm.positions[:, j], lw=1.4, label=name.replace("panda_", ""))
            lower.plot(t, arm.velocities[:, j], lw=1.2)
        for moment, label in ((arm.grasp_time, "close"), (arm.release_time, "open")):
            if moment is not None:
                for axes in (upper, lower):
                    axes.axvline(moment, color="#b3261e", lw=1, ls="--")
                upper.annotate(label, (moment, upper.get_ylim()[1]), color="#b3261e", fontsize=8, va="top")
        upper.set_ylabel("position, rad")
        lower.set_ylabel("velocity, rad/s")
        phases = arm.phases or plan.tool_motion.phases
    else:
        motion = plan.tool_motion
        t = motion.times
        for axis, name in enumerate("xyz"):
            upper.plot(t, motion.world_from_tool[:, axis, 3], lw=1.5, label=name)
        first = motion.world_from_tool[0]
        lower.plot(t, [np.degrees(transforms.rotation_angle(first, pose)) for pose in motion.world_from_tool], lw=1.5)
        upper.set_ylabel("tool position, m")
        lower.set_ylabel("turn from the start, deg")
        phases = motion.phases
    lower.set_xlabel("time, s")
    _phases(upper, phases)
    upper.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    for axes in (upper, lower):
        axes.grid(alpha=0.25)
        axes.margins(x=0)
    return _figure_image(figure)


# ---------------------------------------------------------------- the page


#: A picture that is wider than so many times its height shows too little on a phone's screen.
BROAD = 1.6


@dataclass(frozen=True)
class Picture:
    """A picture on the page: data URI and what stands below it; broad: on a phone it is scrolled
    along, not shrunk to the screen's width."""

    uri: str
    caption: str
    broad: bool = False


@dataclass(frozen=True)
class Section:
    """Pictures in rows under a title; layout: the template's class for a row (row, cards, cards wide)."""

    title: str
    rows: tuple[tuple[Picture, ...], ...] = ()
    layout: str = "cards"
    note: str = ""
    texts: tuple[str, ...] = ()


def _picture(image: Image, caption: str, quality: int = 0) -> Picture:
    return Picture(data_uri(image, quality), caption, image.shape[1] > BROAD * image.shape[0])


def _guard(title: str, draw: Callable[[], Section]) -> Section:
    """A section; one that cannot be drawn says why and leaves the others alone."""
    try:
        return draw()
    except Exception as error:
        return Section(title, note=f"could not be drawn: {type(error).__name__}: {error}")


def _facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts = [
        ("strategy", summary["strategy"]),
        ("variant", summary["variant"]),
        ("features", summary["features"]),
        ("simulations", str(summary["simulations"])),
        ("perceive to verify", f"{summary['seconds']['total']:.2f} s"),
    ]
    if summary["rollouts"]:
        low, high = summary["rate_interval"]
        rate = (
            f"{100 * summary['success_rate']:.0f} % of {summary['rollouts']} rollouts, 95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        )
        facts.insert(2, ("success", rate))
    facts += [("executed", "yes")] if summary["executed"] else []
    return facts + [("date", summary["date"].replace("T", " ")), ("version", summary["version"])]


def _cameras(record: Record, scene: Scene | None) -> Section:
    title, rows, texts = "What the cameras saw", [], []
    colors = {t: m for t, m in record.images.items() if "/color/" in t}
    for topic, message in sorted(colors.items()):
        prefix = topic.rsplit("color/", 1)[0]
        name = prefix.rstrip("/").rsplit("/", 1)[-1]
        pictures = []
        try:
            color = conversions.color_from_msg(message)
            pictures.append(_picture(color, f"{name}: colour, {color.shape[1]} x {color.shape[0]}", 88))
        except MagicError as error:
            color = None
            texts.append(f"{topic}: {error.message}")
        depth = record.images.get(prefix + "aligned_depth_to_color/image_raw")
        if depth is not None:
            try:
                values = conversions.depth_from_msg(depth)
                share = float(np.isfinite(values).mean())
                pictures.append(_picture(depth_picture(values), f"{name}: depth, {100 * share:.0f} % of the pixels have one"))
            except MagicError as error:
                texts.append(f"{name} depth: {error.message}")
        if scene is not None and color is not None:
            masks = [
                (o.id, o.mask, PALETTE[i % len(PALETTE)]) for i, o in enumerate(scene.objects) if o.mask is not None and o.camera == name
            ]
            if masks:
                pictures.append(_picture(masks_picture(color, masks), f"{name}: masks of {', '.join(m[0] for m in masks)}", 90))
        rows.append(tuple(pictures))
    return Section(title, tuple(rows), "row", "" if rows or texts else "No image came.", tuple(texts))


def _contacts(strategy: strategies.Strategy, scene: Scene | None, result: Any) -> Section:
    from magic_core.views import view_of_contact

    pictures = [
        _picture(
            contact_picture(strategy.tool_view, strategy.tool_contact),
            f"demonstration: tool; r = {1000 * strategy.tool_contact.radius:.1f} mm, {'concave' if strategy.tool_contact.concave else 'convex'}",
        ),
        _picture(
            contact_picture(strategy.target_view, strategy.target_contact),
            f"demonstration: target; r = {1000 * strategy.target_contact.radius:.1f} mm",
        ),
    ]
    if scene is not None and result is not None and result.candidates:
        kept = next((r for r in result.candidates if r.code == Code.OK), result.candidates[0])
        candidate = conversions.candidate_from_msg(kept.candidate)
        best = conversions.candidate_from_msg(result.candidates[0].candidate)
        tool = scene.find(candidate.tool_id)
        view = view_of_contact(tool, strategy.view, candidate.tool.object_from_contact)
        if len(result.heatmap.data):
            heat = conversions.float_image_from_msg(result.heatmap)
            first = view_of_contact(scene.find(best.tool_id), strategy.view, best.tool.object_from_contact)
            caption = f"{best.tool_id}: heat map of the match and the best candidate"
            pictures.append(_picture(contact_picture(first, best.tool, heat_picture(first, heat)), caption))
        what = "the contact that was kept" if kept.code == Code.OK else "the best candidate, not kept"
        radius = f"r = {1000 * candidate.tool.radius:.1f} mm, {'concave' if candidate.tool.concave else 'convex'}"
        pictures.append(_picture(contact_picture(view, candidate.tool), f"{candidate.tool_id}: {what}; {radius}"))
        if candidate.target is not None and result.target_id:
            target = scene.find(result.target_id)
            caption = f"{result.target_id}: its contact; r = {1000 * candidate.target.radius:.1f} mm"
            pictures.append(_picture(contact_picture(target_view(target, strategy), candidate.target), caption))
    note = "Point: the contact. Arrow: its outward normal. Circle: the circle of curvature."
    return Section("From the demonstrated contact to the new one", (tuple(pictures),), note=note)


def _meshes(scene: Scene, result: Any) -> Section:
    from magic_core.rendering import Raycaster, shade

    path = None
    if result is not None and result.plan.tool_trajectory.points:
        path = np.array([[getattr(p.transforms[0].translation, a) for a in "xyz"] for p in result.plan.tool_trajectory.points])
    pictures = [_picture(scene_picture(scene, path), "the reconstructed scene" + (" with the tool's path" if path is not None else ""), 92)]
    for index, item in enumerate(scene.objects):
        mesh = item.mesh if item.mesh.colors is not None and item.mesh.colors.any() else item.mesh.painted(PALETTE[index % len(PALETTE)])
        low, high = mesh.bounds
        center, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.01)
        camera = look_at(center + 1.5 * reach * transforms.unit([-0.6, -0.75, 0.8]), center)
        intrinsics = Intrinsics(450, 300, 420.0, 420.0, 224.5, 149.5)
        cast, _ = Raycaster([mesh]).perspective(intrinsics, camera)
        extent = " x ".join(f"{1000 * x:.0f}" for x in mesh.extents)
        caption = f"{item.id} ({item.source}): {extent} mm, {len(mesh.faces)} triangles, {len(item.pieces)} convex pieces"
        pictures.append(_picture(shade(cast, light=(-0.5, -0.3, 1.0), background=(236, 239, 244)), caption, 90))
    return Section("What was reconstructed", (tuple(pictures),), "cards wide")


#: Units of what verifiers measure, by the name's last word; what is not here has none.
UNITS = {"distance": "m", "drift": "m", "height": "m", "highest": "m", "overlap": "m", "contact": "m", "slip": "m", "shift": "m", "width": "m", "radius": "m",
         "speed": "m/s", "turn": "rad", "error": "rad"}  # fmt: skip


def measured(metrics: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """What was measured, in words: names and values, lengths in mm."""
    shown = []
    for name, value in metrics.items():
        unit = UNITS.get(name.rsplit("_", 1)[-1], "")
        if value is None:
            text = "not finite"
        elif unit == "m":
            text = f"{1000 * value:.1f} mm"
        else:
            text = f"{value:.3g} {unit}".strip()
        shown.append((name.replace("_", " "), text))
    return shown


def _bar(seconds: Mapping[str, float]) -> list[dict[str, str]]:
    colors = {"perceive": "#1f5fbf", "match": "#7b4fb5", "plan": "#c2741b", "verify": "#12805c"}
    total = max(sum(seconds[s] for s in colors), 1e-9)
    return [
        {"name": s, "seconds": f"{seconds[s]:.2f}", "share": f"{100 * seconds[s] / total:.2f}", "color": color}
        for s, color in colors.items()
    ]


def _logs(folder: Path | None) -> list[tuple[str, str]]:
    files = sorted(folder.glob("*.log")) if folder is not None and folder.is_dir() else []
    return [(path.stem, "\n".join(path.read_text(errors="replace").splitlines()[-60:])) for path in files]


def render(record: Record, logs: Path | None = None) -> str:
    """The whole page; logs: a folder of log files whose ends are shown."""
    # A summary of an earlier version lacks what came later.
    summary, result = {**empty_summary("", ""), "date": "", "version": "", **record.summary}, record.result
    scene: Scene | None = None
    strategy: strategies.Strategy | None = None
    problems = []
    try:
        scene = conversions.scene_from_msg(record.scene) if record.scene is not None and record.scene.objects else None
    except MagicError as error:
        problems.append(f"objects: {error.message}")
    try:
        strategy = strategies.find(summary["strategy"])
    except (MagicError, LookupError) as error:
        problems.append(f"strategy: {error}")
    sections = []
    if record.video:
        uri = f"data:image/webp;base64,{base64.b64encode(record.video).decode()}"
        sections.append(Section("The run", ((Picture(uri, "what the cameras saw, twice as fast as it was"),),), "row"))
    sections.append(_guard("What the cameras saw", lambda: _cameras(record, scene)))
    if strategy is not None:
        sections.append(_guard("From the demonstrated contact to the new one", lambda: _contacts(strategy, scene, result)))
    if scene is not None:
        sections.append(_guard("What was reconstructed", lambda: _meshes(scene, result)))
    if result is not None and len(result.film.data):
        sections.append(_guard("Simulation", lambda: _single("Simulation", _film(result), "the last simulation, in reading order", 90)))
    if result is not None and result.plan.tool_trajectory.points:
        title = "Joints" if summary["variant"] == "arm" else "Motion of the tool"
        note = "" if summary["success"] else "This motion was not verified."
        sections.append(_guard(title, lambda: _single(title, motion_picture(conversions.plan_from_msg(result.plan)), title, 0, note)))
    if problems:
        sections.append(Section("Left out", texts=tuple(problems)))
    page = _environment().get_template("report.html")
    return page.render(
        summary=summary, code=Code(summary["code"]).name, facts=_facts(summary), sections=sections, bar=_bar(summary["seconds"]), terms=TERMS,
        logs=_logs(logs),
    )  # fmt: skip


def _film(result: Any) -> Image:
    return conversions.color_from_msg(result.film)


def _single(title: str, image: Image, caption: str, quality: int, note: str = "") -> Section:
    return Section(title, ((_picture(image, caption, quality),),), "row", note)


def _environment() -> jinja2.Environment:
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    made.filters["measured"] = measured
    return made


def write(record: Record, path: Path, logs: Path | None = None) -> None:
    """Write the page of a record; names of files that are no UTF-8 are shown with question marks."""
    path.write_text(render(record, logs), encoding="utf-8", errors="replace")


# ---------------------------------------------------------------- records on disk


def save(record: Record, folder: Path) -> None:
    """Keep a record's messages (CDR) beside its summary, so that the report can be drawn again."""
    from rclpy.serialization import serialize_message

    messages = folder / "messages"
    messages.mkdir(parents=True, exist_ok=True)
    for old in messages.glob("*.cdr"):
        old.unlink()
    for topic, message in record.images.items():
        (messages / f"image{topic.replace('/', '@')}.cdr").write_bytes(serialize_message(message))
    for name, message in (("objects", record.scene), ("result", record.result)):
        if message is not None:
            (messages / f"{name}.cdr").write_bytes(serialize_message(message))
    if record.video:
        (messages / VIDEO).write_bytes(record.video)


def load(folder: Path) -> Record:
    """What :func:`save` kept; raises BAD_REQUEST for a folder without a run."""
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Image as ImageMsg

    from magic_interfaces.action import RunStrategy
    from magic_interfaces.msg import SceneObjectArray

    if not (folder / "summary.json").is_file():
        raise MagicError(
            Code.BAD_REQUEST, "folder of a run", str(folder), "one with a summary.json, as demo.sh and magic run --out write it"
        )
    record = Record(json.loads((folder / "summary.json").read_text()))
    messages = folder / "messages"
    for path in sorted(messages.glob("image*.cdr")):
        record.images[path.stem[len("image") :].replace("@", "/")] = deserialize_message(path.read_bytes(), ImageMsg)
    for name, kind in (("objects", SceneObjectArray), ("result", RunStrategy.Result)):
        path = messages / f"{name}.cdr"
        if path.is_file():
            setattr(record, "scene" if name == "objects" else name, deserialize_message(path.read_bytes(), kind))
    if (messages / VIDEO).is_file():
        record.video = (messages / VIDEO).read_bytes()
    return record


def main(argv: list[str] | None = None) -> None:
    """``ros2 run magic_bringup report DIR``."""
    parser = argparse.ArgumentParser(
        prog="report", description="Draw report.html again from a folder that demo.sh or magic run --out wrote."
    )
    parser.add_argument("folder", type=Path, help="the folder that was given by --out")
    parser.add_argument("-o", "--output", type=Path, help="file to write (default FOLDER/report.html)")
    arguments = parser.parse_args([a for a in (sys.argv[1:] if argv is None else argv) if a != "--ros-args"])
    try:
        output = arguments.output or arguments.folder / "report.html"
        write(load(arguments.folder), output, arguments.folder / "logs")
    except (MagicError, OSError) as error:
        print(f"report: {error}", file=sys.stderr)
        sys.exit(1)
    print(output)


if __name__ == "__main__":
    main()
