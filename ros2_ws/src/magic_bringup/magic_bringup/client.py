"""The graph from a terminal: ``ros2 run magic_bringup magic run|match|objects|strategies|doctor``.

What ``ros2 action send_goal`` prints of a run are tens of thousands of lines, meshes and images among them; this prints
what a person wants to know of it.  Exit status: 0 where the answer is OK (``doctor``: where nothing is missing), 1 where
not, 2 for wrong arguments, 130 when interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
import signal
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage, Image

from magic_bringup import rerun_recording
from magic_bringup.connection import Client, connected
from magic_bringup.doctor import examine
from magic_bringup.record import IMAGES, Record, empty_summary, is_picture, raw_topic, shown, take, write_summary
from magic_core import conversions, presence, qos
from magic_core import strategy as strategies
from magic_core.arguments import split
from magic_core.entry import version
from magic_core.errors import Code, MagicError
from magic_core.motion import VARIANTS
from magic_core.remedies import REMEDIES
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_server.pipeline import split_metrics

#: What is waited beyond a run's own time for its answer, s.
GRACE = 30.0


def say(line: str = "") -> None:
    """One line, at once: whole, as feedback comes in several threads."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


# ------------------------------------------------------------ run


class Witness:
    """What a run was made from, for its report: the newest objects, and the first picture of every camera topic there is.

    Topics are found while the run goes on; of each the first message is kept as it came (serialised) and no more is listened to.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = ReentrantCallbackGroup()
        self._scene: Any = None
        self._heard: dict[str, tuple[type, bytes]] = {}
        self._open: dict[str, Any] = {}
        node.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED, callback_group=self._group)
        self._timer = node.create_timer(0.5, self._look, MutuallyExclusiveCallbackGroup())

    def _on_objects(self, message: Any) -> None:
        self._scene = message

    def _look(self) -> None:
        for topic in [t for t in self._open if t in self._heard]:
            self._node.destroy_subscription(self._open.pop(topic))
        space = self._node.get_namespace().rstrip("/") + "/"
        there = {
            t: kinds[0] for t, kinds in self._node.get_topic_names_and_types() if t.startswith(space) and self._node.count_publishers(t)
        }
        for topic, name in there.items():
            compressed = topic != raw_topic(topic)
            if not is_picture(topic) or name not in IMAGES or topic in self._open or topic in self._heard:
                continue
            if compressed and raw_topic(topic) in there:
                continue
            kind = CompressedImage if compressed else Image
            self._open[topic] = self._node.create_subscription(
                kind, topic, lambda m, t=topic, k=kind: self._heard.setdefault(t, (k, m)), qos.SENSOR, callback_group=self._group, raw=True
            )

    def record(self, summary: dict[str, Any], result: Any) -> Record:
        """The record of the run that has ended."""
        self._node.destroy_timer(self._timer)
        images = {}
        for topic, (kind, data) in sorted(self._heard.items()):
            with contextlib.suppress(MagicError):  # a picture less in the report
                images[raw_topic(topic)] = shown(deserialize_message(data, kind))
        return Record(summary, images, self._scene, result)


def run(client: Client, given: argparse.Namespace) -> int:
    """A run with its progress, what came of it, and why."""
    if given.rerun:
        rerun_recording.rerun()
        if given.out is None:
            raise MagicError(Code.BAD_REQUEST, "--rerun", "without --out", "a folder for it: --out DIR")
    witness = Witness(client.node) if given.out is not None else None
    begin, said = time.monotonic(), [""]

    def progress(feedback: Any) -> None:
        line = f"{feedback.stage}: {split_metrics(feedback.message)[0]}"
        if line != said[0]:
            said[0] = line
            say(f"[{time.monotonic() - begin:6.1f} s] {line}")

    goal = RunStrategy.Goal(
        strategy=_strategy_name(given.strategy),
        variant=given.variant,
        tool_id=given.tool,
        target_id=given.target,
        tool_mass=given.tool_mass,
        target_mass=given.target_mass,
        seed=given.seed,
        timeout=given.timeout,
        want_pictures=given.out is not None,
    )
    server = client.action(RunStrategy, "run_strategy", "strategy server")
    result = server.call(goal, given.timeout or 3600.0, client.token, grace=GRACE, feedback=progress).result
    for line in run_lines(result):
        say(line)
    if witness is not None:
        for path in pictures(result, given.out):
            say(f"  picture    {path}")
        summary = empty_summary(goal.strategy, given.variant, command=given.command)
        take(summary, result)
        record = witness.record(summary, result)
        say(f"  report     {written(record, given.out)}")
        if given.rerun:
            say(f"  rerun      {rerun_recording.write(record, given.out)}")
    return 0 if result.code == Code.OK else 1


def written(record: Record, folder: Path) -> Path:
    """Write ``summary.json``, the messages, the bag ``run`` and ``report.html`` of a run into a folder that is there; the page's path."""
    from magic_bringup import report, run_bag

    write_summary(record, folder)
    report.save(record, folder)
    report.write(record, folder / "report.html")
    run_bag.write(record, folder)
    return folder / "report.html"


def run_lines(result: Any) -> list[str]:
    """What a RunStrategy result says, in lines for a terminal."""
    verdict = "VERIFIED" if result.verified else "not verified"
    lines = [f"{verdict}: {Code(result.code).name} ({result.code}): {split_metrics(result.message)[0]}"]
    if result.code != Code.OK:
        lines.append(f"  to do      {REMEDIES[Code(result.code)].mend}")
    if result.rollouts:
        lines.append(
            f"  success    {100 * result.success_rate:.0f} % of {result.rollouts} rollouts, "
            f"95 % interval {100 * result.rate_low:.0f} to {100 * result.rate_high:.0f} %"
        )
    lines += [f"  failing    {reason}" for reason in result.failures]
    if result.tool_id:
        lines.append(f"  tool       {result.tool_id} on {result.target_id}, matched by {result.features} features")
    arm = result.plan.arm_trajectory
    points, joints = (arm.points, f"{len(arm.joint_names)} joints") if arm.points else (result.plan.tool_trajectory.points, "the tool")
    if points and result.verified:
        end = points[-1].time_from_start
        lines.append(f"  motion     {len(points)} points of {joints} in {end.sec + 1e-9 * end.nanosec:.1f} s")
    lines.append(f"  executed   {'yes' if result.executed else 'no'}")
    lines += [f"  note       {note}" for note in result.notes]
    times = result.times
    lines.append(
        f"  seconds    perceive {times.perceive:.2f}, match {times.match:.2f}, plan {times.plan:.2f}, verify {times.verify:.2f}, "
        f"total {times.total:.2f}; {result.simulations} simulations"
    )
    for number, report in enumerate(result.candidates):
        if report.code != Code.OK:
            c = report.candidate
            reason = split_metrics(report.message)[0]
            lines.append(f"  dropped    {number}: {c.tool_id} (score {c.score:.2f}), {report.stage}: {Code(report.code).name}: {reason}")
    return lines


def pictures(result: Any, folder: Path) -> list[Path]:
    """The film strip and the heat map of a result as PNG files; those that there are."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    if len(result.film.data):
        written.append(folder / "simulation.png")
        cv2.imwrite(str(written[-1]), conversions.color_from_msg(result.film)[:, :, ::-1])
    if len(result.heatmap.data):
        heat = np.nan_to_num(conversions.float_image_from_msg(result.heatmap))
        written.append(folder / "heatmap.png")
        cv2.imwrite(str(written[-1]), cv2.applyColorMap((255 * np.clip(heat, 0, 1)).astype(np.uint8), cv2.COLORMAP_VIRIDIS))
    return written


# ------------------------------------------------------------ match, objects, strategies


def match(client: Client, given: argparse.Namespace) -> int:
    """The contacts that correspond to the demonstration's, best first."""
    request = MatchContact.Request(strategy=_strategy_name(given.strategy), tool_ids=given.tool, target_id=given.target, top_k=given.top_k)
    response = client.service(MatchContact, "match_contact", "matcher").call(request, given.timeout, client.token)
    say(f"{Code(response.code).name} ({response.code}): {response.message}")
    if response.code != Code.OK:
        say(f"  to do      {REMEDIES[Code(response.code)].mend}")
    if response.candidates:
        say(f"  target {response.target_id}, {response.features} features, {response.seconds:.2f} s")
        say(f"  {'tool':<12} {'score':>6} {'global':>7} {'local':>6} {'turn':>6}  {'x, y, z in mm':<22} radius")
    for c in response.candidates:
        place = ", ".join(f"{1000 * v:.0f}" for v in (c.point.x, c.point.y, c.point.z))
        kind = "inside" if c.tool.concave else "outside"
        mirrored = ", mirrored" if c.flipped else ""
        say(
            f"  {c.tool_id:<12} {c.score:6.3f} {c.s_dino:7.3f} {c.s_curv:6.3f} {np.degrees(c.rotation):5.0f}°  {place:<22} "
            f"{1000 * c.tool.radius:.0f} mm, {kind}{mirrored}"
        )
    return 0 if response.code == Code.OK else 1


def objects(client: Client, given: argparse.Namespace) -> int:
    """What stands on the table."""
    scene = client.objects(given.timeout)
    now = None if presence.playing(client.node) else client.node.get_clock().now().nanoseconds * 1e-9
    for line in object_lines(scene, now):
        say(line)
    return 0


def object_lines(scene: Any, now: float | None) -> list[str]:
    """An ``objects`` message in lines; now in s, ``None`` while a bag is played."""
    stamp = scene.header.stamp.sec + 1e-9 * scene.header.stamp.nanosec
    plural = "" if len(scene.objects) == 1 else "s"
    seen = "of the bag that is played" if now is None else f"seen {now - stamp:.1f} s ago"
    lines = [f"{len(scene.objects)} object{plural} in {scene.header.frame_id or 'no frame'}, {seen}"]
    lines.append(f"  {'id':<14} {'source':<8} {'size in mm':<18} {'middle in mm':<20} {'sure':>5} {'seen':>5}")
    for o in scene.objects:
        size = " x ".join(f"{1000 * v:.0f}" for v in sorted((o.box_size.x, o.box_size.y, o.box_size.z), reverse=True))
        p = o.box_pose.position
        middle = ", ".join(f"{1000 * v:.0f}" for v in (p.x, p.y, p.z))
        known = o.source == "known"
        sure, seen = ("", "") if known else (f"{100 * o.confidence:.0f} %", f"{100 * o.seen_share:.0f} %")
        remarks = ["cut off by " + ", ".join(o.cut_off)] if o.cut_off else []
        remarks += ["hangs above the table"] if o.hanging else []
        lines.append(f"  {o.id:<14} {o.source:<8} {size:<18} {middle:<20} {sure:>5} {seen:>5}  {'; '.join(remarks)}".rstrip())
    return lines + [f"  note: {note}" for note in scene.notes]


def list_strategies(folder: str) -> int:
    """The strategies that are installed, or those of a folder."""
    root = Path(folder) if folder else strategies.installed_folder()
    found = sorted(path.parent for path in root.glob("*/strategy.yaml"))
    say(f"{len(found)} in {root}" if found else f"none in {root}")
    for path in found:
        try:
            strategy = strategies.load(path)
            say(f"  {path.name:<14} goal {strategy.goal.title}, {strategy.mode}: {strategy.description}")
        except MagicError as error:
            say(f"  {path.name:<14} cannot be used: {error}")
    return 0 if found else 1


# ------------------------------------------------------------ doctor


def doctor(client: Client, given: argparse.Namespace) -> int:
    """What is missing for the graph to work, and how to mend it."""
    findings = examine(client, given.timeout, given.cameras)
    for level, text, mend in findings:
        say(f"{level:<5} {text}")
        if mend and level != "ok":
            say(f"      mend: {mend}")
    bad = sum(level == "FAIL" for level, _, _ in findings)
    say(f"{bad} to mend" if bad else "nothing is missing")
    return 1 if bad else 0


# ------------------------------------------------------------ command line


def _strategy_name(name: str) -> str:
    """A folder's path whole: the server has another working directory."""
    return str(Path(name).resolve()) if "/" in name else name


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(prog="magic", description="What the graph sees, matches, plans and verifies, from a terminal.")
    top.add_argument("--version", action="version", version=f"magic_bringup {version('magic_bringup')}")
    verbs = top.add_subparsers(dest="verb", required=True)
    one = verbs.add_parser("run", help="use a tool as a demonstration showed it")
    one.add_argument("strategy", help="hooking, hanging, scooping, or the folder of a strategy")
    one.add_argument("--variant", default="arm", choices=VARIANTS, help="fg: a floating gripper; arm: the robot (default)")
    one.add_argument("--tool", default="", help="the tool: an id, or a name such as 'the red mug' (default: the matcher chooses)")
    one.add_argument("--target", default="", help="the target: an id or a name (default: the matcher chooses)")
    one.add_argument("--tool-mass", type=float, default=0.0, metavar="KG", help="what the tool weighs (default: by the strategy's density)")
    one.add_argument("--target-mass", type=float, default=0.0, metavar="KG", help="what the target weighs (likewise)")
    one.add_argument("--seed", type=int, default=0, help="seed of all random choices (default 0)")
    one.add_argument("--timeout", type=float, default=0.0, help="s for everything (default: the server's)")
    one.add_argument("--out", type=Path, help="folder for report.html, summary.json and pictures: the simulation, the heat map")
    one.add_argument("--rerun", action="store_true", help="write run.rrd into it as well, for the rerun viewer (an extra)")
    two = verbs.add_parser("match", help="find the corresponding contacts")
    two.add_argument("strategy", help="hooking, hanging, scooping, or the folder of a strategy")
    two.add_argument("--tool", nargs="+", default=[], help="object ids to choose the tool from (default: all)")
    two.add_argument("--target", default="", help="object id of the target (default: the matcher chooses)")
    two.add_argument("--top-k", type=int, default=0, help="how many (default: the matcher's)")
    two.add_argument("--timeout", type=float, default=60.0, help="s (default 60)")
    three = verbs.add_parser("objects", help="what stands on the table")
    three.add_argument("--timeout", type=float, default=10.0, help="s to wait for it (default 10)")
    four = verbs.add_parser("strategies", help="what has been learned")
    four.add_argument("--folder", default="", help="of strategies (default: the installed ones)")
    five = verbs.add_parser("doctor", help="what is missing for the graph to work")
    five.add_argument("--timeout", type=float, default=10.0, help="s for the nodes to be found (default 10)")
    five.add_argument("--cameras", nargs="+", default=[], metavar="NAME", help="cameras to look at (default: those of perception)")
    return top


def main(arguments: list[str] | None = None) -> int:
    """Run one verb; returns the exit status."""
    plain, _ = split(sys.argv[1:] if arguments is None else arguments)
    given = parser().parse_args(plain)
    given.command = shlex.join(["ros2", "run", "magic_bringup", "magic", *plain])
    try:
        if given.verb == "strategies":
            return list_strategies(given.folder)
        with connected(arguments) as client:
            # A run that nobody waits for any more is canceled, not left to the server.
            before = signal.signal(signal.SIGINT, lambda *_: client.token.cancel())
            try:
                return {"run": run, "match": match, "objects": objects, "doctor": doctor}[given.verb](client, given)
            finally:
                signal.signal(signal.SIGINT, before)
    except MagicError as error:
        say(f"{error.code.name} ({int(error.code)}): {error.message}")
        if error.code != Code.CANCELED:
            say(f"  to do      {REMEDIES[error.code].mend}")
        return 130 if error.code == Code.CANCELED else 1


if __name__ == "__main__":
    sys.exit(main())
