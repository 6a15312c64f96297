"""Trials in the laboratory: resets, goals that are carried out, each judged on the truth.

``ros2 run magic_lab trials --scenario NAME --trials 10 --seed S --out DIR`` starts the graph and the laboratory, and does so many
trials with each object of the scenario.  DIR gets one JSON file, one picture and one animated WebP a trial, and ``trials.json`` with
the sums; what is there already is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_bringup.demo import START_TIMEOUT, Options, Watcher
from magic_bringup.graph import Graph, Process
from magic_core import environment
from magic_core.domain import isolated
from magic_core.errors import Code, MagicError
from magic_lab.judge import Track, judge, loop_in_sight, middle, nearest
from magic_lab.scenarios import SCENARIOS, Scenario, Scene, case_of, draw, scenario_of
from magic_server.pipeline import split_metrics
from magic_verifier.rates import wilson

Image = NDArray[np.uint8]

#: The stage that a code belongs to, by its hundreds.
STAGES = {1: "perceive", 2: "match", 3: "plan", 4: "verify", 5: "execute"}
#: How long things are looked for on the table after a reset, and a run may take, s by the wall's clock.
LOOK, RUN = 60.0, 300.0
#: How long the truth is followed after a run has ended, s by the laboratory's clock.
AFTER = 1.0
#: The arm has begun to move once its hand is so far from where it was, m.
BEGUN = 0.01
#: This share of a loop's opening has to be in a camera's sight for somebody to find it.
SHOWN = 0.05
#: A thing that perception sees is nearer to the true one than this share of its longest side.
NEAR = 0.35
#: Size of each camera's picture in the video, how long each picture stands, ms (twice as fast as it was), and how many there are at most:
#: of a long trial every second or third is left.
SIZE, FRAME_MS, MOST_FRAMES = (400, 300), 100, 120
#: Parameters of the graph beside a laboratory.
SERVER = {"execute": True, "autostart": True, "effort": 60.0}


@dataclass
class Seen:
    """What came in since the reset, stamps by the laboratory's clock: the truth, pictures by camera (JPEG), what was said when, and of each
    camera the first picture as it came."""

    truth: list[tuple[float, dict[str, Any]]] = field(default_factory=list)
    pictures: list[tuple[float, str, bytes]] = field(default_factory=list)
    lines: list[tuple[float, str]] = field(default_factory=list)
    first: dict[str, Any] = field(default_factory=dict)


class Session:
    """A graph with a laboratory, and what a trial asks of them; use it in a ``with`` statement."""

    def __init__(
        self,
        logs: Path,
        say: Any = lambda _line: None,
        server: dict[str, Any] | None = None,
        lab: dict[str, Any] | None = None,
        pictures: bool = False,
    ) -> None:
        """say: what is told as it happens; server, lab: more parameters of the strategy server and of the laboratory; pictures: results
        are to have the film strip and the heat map."""
        from magic_lab.node import TCP

        self.say, self.pictures = say, pictures
        self._hand = TCP
        self.seen = Seen()
        self.now = 0.0
        self.result: Any = None  # of the last run
        env = isolated()
        self._before = {k: os.environ.get(k) for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
        os.environ.update({k: env[k] for k in self._before})
        self.graph = Graph(logs, env)
        self.watcher: Watcher | None = None
        try:
            self._start(logs, env, server or {}, lab or {})
        except BaseException:  # nobody would stop what has been started
            self.__exit__()
            raise

    def _start(self, logs: Path, env: dict[str, str], server: dict[str, Any], lab: dict[str, Any]) -> None:
        """Start graph, laboratory and what listens to them."""
        from rclpy.parameter_client import AsyncParameterClient
        from sensor_msgs.msg import Image as ImageMsg
        from std_srvs.srv import Trigger
        from tf2_msgs.msg import TFMessage

        from magic_core import qos
        from magic_core.listening import listen_apart

        simulated = {"use_sim_time": True}
        nodes = ("perception", "matcher", "planner", "verifier", "strategy_server")
        parameters: dict[str, dict[str, object]] = {name: dict(simulated) for name in nodes}
        parameters["matcher"]["features"] = "embedded"
        parameters["strategy_server"].update({**SERVER, **server})
        self.graph.start_nodes(parameters)
        given = [x for k, v in lab.items() for x in ("-p", f"{k}:={str(v).lower() if isinstance(v, bool) else v}")]
        command = [sys.executable, "-m", "magic_lab.node", *(["--ros-args", *given] if given else [])]
        self.graph.processes["lab"] = Process.start("lab", command, logs / "lab.log", env)
        self.watcher = Watcher((), self._on_line)
        node = self.watcher.node
        listen_apart(node, TFMessage, "lab/truth", self._on_truth, qos.RELIABLE)
        for camera in ("left", "right"):
            topic = f"camera/{camera}/color/image_raw"
            listen_apart(node, ImageMsg, topic, lambda message, name=camera: self._on_picture(name, message), qos.SENSOR)
        self._parameters = AsyncParameterClient(node, "lab")
        self._reset = node.create_client(Trigger, "lab/reset")

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.stop()
        if self.watcher is not None:
            self.watcher.close()
        for key, value in self._before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value

    # ------------------------------------------------------------ what comes in

    def _on_line(self, line: str) -> None:
        self.say(line)
        self.seen.lines.append((self.now, line))

    def _on_truth(self, message: Any) -> None:
        from magic_core import conversions as cv

        self.now = cv.time_from_msg(message.transforms[0].header.stamp)
        self.seen.truth.append((self.now, {t.child_frame_id: cv.transform_from_msg(t.transform) for t in message.transforms}))

    def _on_picture(self, camera: str, message: Any) -> None:
        from magic_core import conversions as cv

        self.seen.first.setdefault(f"/camera/{camera}/color/image_raw", message)
        small = cv2.cvtColor(cv2.resize(cv.color_from_msg(message), SIZE), cv2.COLOR_RGB2BGR)
        self.seen.pictures.append((cv.time_from_msg(message.header.stamp), camera, cv2.imencode(".jpg", small)[1].tobytes()))

    # ------------------------------------------------------------ what is done

    def wait(self, done: Any, timeout: float, what: str) -> None:
        """Until something is so; raises SERVER_TIMEOUT, and SERVER_UNAVAILABLE where a process has died."""
        deadline = time.monotonic() + timeout
        while not done():
            self.graph.check()
            lab = self.graph.processes["lab"]
            if lab.status is not None:
                raise MagicError(Code.SERVER_UNAVAILABLE, f"the laboratory has died: {lab.tail(1)}")
            if time.monotonic() > deadline:
                raise MagicError(Code.SERVER_TIMEOUT, f"not within {timeout:g} s: {what}")
            time.sleep(0.05)

    def ready(self) -> None:
        """Until everything is up."""
        self.wait(lambda: not self.watcher.ready() and self._reset.service_is_ready(), START_TIMEOUT, "graph and laboratory are up")

    def reset(self, scenario: str, case: str, seed: int, events: str = "") -> None:
        """The scene anew; raises BAD_SCENE with what the laboratory says."""
        from rclpy.parameter import Parameter
        from std_srvs.srv import Trigger

        values = {"scenario": scenario, "object": case, "seed": seed, "events": events}
        setting = self._parameters.set_parameters([Parameter(name, value=value) for name, value in values.items()])
        self.wait(setting.done, 30.0, "the laboratory takes its parameters")
        refused = [r.reason for r in setting.result().results if not r.successful]
        if refused:
            raise MagicError(Code.BAD_REQUEST, f"the laboratory: {refused[0]}")
        answer = self._reset.call_async(Trigger.Request())
        self.wait(answer.done, 90.0, "the laboratory begins anew")
        if not answer.result().success:
            raise MagicError(Code.BAD_SCENE, f"the laboratory: {answer.result().message}")
        begun = self.now
        self.wait(lambda: self.now > begun, 10.0, "the truth is told")
        self.seen = Seen(truth=[s for s in self.seen.truth if s[0] > begun])

    def find(self, scene: Scene, since: float) -> dict[str, str]:
        """Ids under which perception knows tools and target, by their true names, in what it saw
        after ``since``; empty: not all of them."""
        from magic_core import conversions as cv

        message = self.watcher.scene
        if message is None or cv.time_from_msg(message.header.stamp) <= since or not self.seen.truth:
            return {}
        places = {o.id: cv.pose_from_msg(o.box_pose)[:3, 3] for o in message.objects}
        found: dict[str, str] = {}
        for name in (*scene.tools, scene.target):
            thing = scene.thing(name)
            where = middle(thing, self.seen.truth[-1][1].get(name, thing.item.world_from_object))
            left = {i: p for i, p in places.items() if i not in found.values()}
            if not left or np.linalg.norm((left[best := nearest(left, where)] - where)[:2]) > NEAR * thing.item.mesh.extents.max():
                return {}
            found[name] = best
        return found

    def look(self, scene: Scene) -> dict[str, str]:
        """The same, waited for."""
        since, found = self.now, {}

        def seen() -> bool:
            found.update(self.find(scene, since))
            return bool(found)

        try:
            self.wait(seen, LOOK, "")
        except MagicError as error:
            if error.code != Code.SERVER_TIMEOUT:
                raise
            ids = [o.id for o in self.watcher.scene.objects] if self.watcher.scene is not None else []
            raise MagicError(Code.NO_OBJECTS, "things that perception does not see where they are, among", ids or "none") from None
        return found

    def run(self, timeout: float = RUN, **goal: Any) -> Any:
        """The result of one run of a strategy with the arm."""
        self.result = None
        options = Options(**{"variant": "arm", "bag": Path(), "out": Path(), "timeout": timeout, "pictures": self.pictures, **goal})
        pending = self.watcher.send(options)
        self.wait(lambda: pending.result is not None, timeout + 60.0, "the strategy server answers")
        self.result = pending.result
        return self.result

    def trial(self, scenario: Scenario, case: str, seed: int, out: Path, events: str = "") -> dict[str, Any]:
        """One trial, as plain data; it, its picture and its video lie in ``out``."""
        record: dict[str, Any] = {
            "scenario": scenario.name,
            "object": case,
            "seed": seed,
            "success": False,
            "verified": False,
            "begun": False,
            "executed": False,
        }
        begun = time.monotonic()
        scene = draw(scenario, case_of(scenario, case, seed), seed)
        found: dict[str, str] = {}
        try:
            self.reset(scenario.name, case, seed, events)
            found = self.look(scene)
            chosen = {} if scenario.chosen else {"tool": found[scene.tools[0]], "target": found[scene.target]}
            looked, began = time.monotonic(), self.now
            result = self.run(strategy=scenario.strategy, seed=seed, **chosen)
            record.update(_told(result, looked - begun, time.monotonic() - looked))
            ended = self.now
            self.wait(lambda: self.now > ended + AFTER, 30.0, "the truth goes on")
            names = {i: name for name, i in found.items()}
            record.update(
                simulated_seconds=round(ended - began, 2),
                tool=names.get(result.tool_id, scene.tools[0]),
                target=names.get(result.target_id, scene.target),
                turn=result.candidates[-1].candidate.turn if result.candidates else 0.0,
            )
        except MagicError as error:
            record.update(code=int(error.code), reason=error.message)
        seen = self.seen
        if len(seen.truth) > 1 and found:
            record.update(self._judged(scene, record))
        record.setdefault("code", int(Code.INTERNAL))
        if record["code"] == Code.HANDLE_NOT_SEEN:
            record["loop_in_sight"] = loop_in_sight(scene, scene.tools[0])
        record["stage"] = stage_of(record)
        record["wall_seconds"] = round(time.monotonic() - begun, 1)
        path = _path(out, case, seed)
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record, indent=2) + "\n")  # what took minutes is not lost to who interrupts the film
        record.update(film(seen, out, path.stem))
        path.write_text(json.dumps(record, indent=2) + "\n")
        return record

    def _judged(self, scene: Scene, record: dict[str, Any]) -> dict[str, Any]:
        """What truly came of a trial of which so much is known: of what was chosen, as it was to be led."""
        track = Track.of(list(self.seen.truth), self._hand).begun(BEGUN)
        if track is None:
            return {"begun": False}
        scene = replace(scene, target=record.get("target", scene.target), strategy=scene.strategy.turned(record.get("turn", 0.0)))
        judgement = judge(scene, record.get("tool", scene.tools[0]), track)
        success = judgement.code == Code.OK and record["executed"]
        return {"begun": True, "truth": int(judgement.code), "judgement": judgement.message, "success": success}


def _told(result: Any, looking: float, running: float) -> dict[str, Any]:
    """What the graph tells of a run; looking, running: seconds by the clock until its things were seen, and of the run."""
    times = result.times
    seconds = {"perceive": looking, "match": times.match, "plan": times.plan, "verify": times.verify}
    seconds["execute"] = max(0.0, running - times.perceive - times.match - times.plan - times.verify)
    return {
        "code": int(result.code),
        "reason": split_metrics(result.message)[0],
        "verified": result.verified,
        "executed": result.executed,
        "attempts": len(result.candidates),
        "refused": [int(candidate.code) for candidate in result.candidates if candidate.code != Code.OK],
        "seconds": {k: round(v, 2) for k, v in seconds.items()},
    }


def stage_of(record: dict[str, Any]) -> str:
    """Where a trial that failed did; empty: it did not."""
    if record["success"]:
        return ""
    if record["code"] == Code.OK:
        return "truth"
    if record["begun"]:
        return "execute"
    # Where no candidate succeeded: how far the one got that came furthest.
    code = max(record.get("refused", []), default=0) if record["code"] == Code.NO_CANDIDATE_SUCCEEDED else record["code"]
    return STAGES.get(code // 100, "execute")


def rightly_refused(record: dict[str, Any]) -> bool:
    """Whether a trial ended with HANDLE_NOT_SEEN where in truth the handle is out of every camera's sight."""
    share = record.get("loop_in_sight")
    return share is not None and share < SHOWN


def film(seen: Seen, out: Path, name: str) -> dict[str, Any]:
    """Write what the cameras saw as an animated WebP, its last frame as a picture, side by side with what was said; their names."""
    # A camera that sends nothing is shown as it was last.
    now: dict[str, bytes] = {}
    pictures = sorted(seen.pictures, key=lambda picture: picture[0])
    stamps = sorted({stamp for stamp, _, _ in pictures})
    every = -(-len(stamps) // MOST_FRAMES)
    shown = set(stamps[::-1][::every]) if stamps else set()
    frames: list[Image] = []
    lines = list(seen.lines)
    dark = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for index, (stamp, camera, data) in enumerate(pictures):
        now[camera] = data
        if stamp not in shown or (index + 1 < len(pictures) and pictures[index + 1][0] == stamp):
            continue
        said = [line for at, line in lines if at <= stamp]
        both = [cv2.imdecode(np.frombuffer(now[c], np.uint8), cv2.IMREAD_COLOR) if c in now else dark for c in ("left", "right")]
        bar = np.full((24, 2 * SIZE[0], 3), 255, np.uint8)
        text = f"{stamp - pictures[0][0]:6.1f} s  {said[-1][:95] if said else ''}"
        cv2.putText(bar, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 45), 1, cv2.LINE_AA)
        frames.append(np.concatenate([np.concatenate(both, axis=1), bar]))
    if not frames:
        return {}
    animation = cv2.Animation()
    animation.frames, animation.durations = frames, np.full(len(frames), FRAME_MS * every)
    files = {"video": f"{name}.webp", "picture": f"{name}.jpg"}
    cv2.imwriteanimation(str(out / files["video"]), animation, [cv2.IMWRITE_WEBP_QUALITY, 50])
    cv2.imwrite(str(out / files["picture"]), frames[-1])
    return files


# ---------------------------------------------------------------- sums


def summary(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What trials came to: by object, failures by stage and reason, how often a verified motion succeeded, mean seconds by stage."""

    def rate(good: int, count: int) -> dict[str, Any]:
        low, high = wilson(good, count)
        return {"good": good, "of": count, "interval": [round(low, 3), round(high, 3)]}

    shown = [r for r in records if not rightly_refused(r)]
    objects = {name: [r for r in records if r["object"] == name] for name in dict.fromkeys(r["object"] for r in records)}
    carried = [r for r in records if r["begun"]]  # the arm moves by what was verified alone
    timed = [r["seconds"] for r in records if "seconds" in r]
    return {
        "scenario": records[0]["scenario"] if records else "",
        "objects": {name: rate(sum(r["success"] for r in own), len(own)) for name, own in objects.items()},
        "verified_motions": rate(sum(r["success"] for r in carried), len(carried)),
        "rightly_refused": len(records) - len(shown),
        "but_rightly_refused": rate(sum(r["success"] for r in shown), len(shown)),
        "failures": [
            {"object": r["object"], "seed": r["seed"], "stage": r["stage"], "code": Code(r["code"]).name, "reason": _reason(r)}
            for r in records
            if not r["success"]
        ],
        "failures_by_stage": dict(Counter(r["stage"] for r in records if not r["success"])),
        "mean_seconds": {k: round(float(np.mean([t[k] for t in timed])), 2) for k in (timed[0] if timed else {})},
        "mean_attempts": round(float(np.mean([r["attempts"] for r in records if "attempts" in r] or [0])), 2),
    }


def _reason(record: dict[str, Any]) -> str:
    return record.get("judgement", record["reason"]) if record["stage"] == "truth" else record["reason"]


def told(total: dict[str, Any]) -> str:
    """The sums as text."""
    lines = [f"{total['scenario']}:"]
    for name, r in {**total["objects"], "verified motions": total["verified_motions"]}.items():
        low, high = (round(100 * x) for x in r["interval"])
        lines.append(f"  {name}: {r['good']} of {r['of']} succeeded ({low} to {high} %)")
    if total["rightly_refused"]:
        rest = total["but_rightly_refused"]
        low, high = (round(100 * x) for x in rest["interval"])
        lines.append(
            f"  rightly refused: {total['rightly_refused']}, the handle is out of every camera's sight; "
            f"of the others {rest['good']} of {rest['of']} succeeded ({low} to {high} %)"
        )
    lines += [f"  failed: {f['object']}, seed {f['seed']}, {f['stage']} [{f['code']}]: {f['reason']}" for f in total["failures"]]
    seconds = ", ".join(f"{k} {v:.1f}" for k, v in total["mean_seconds"].items())
    return "\n".join([*lines, f"  mean seconds: {seconds}; candidates tried: {total['mean_attempts']:.1f}"])


def do(
    scenario: Scenario,
    count: int,
    seed: int,
    out: Path,
    objects: Sequence[str] = (),
    say: Any = print,
    minutes: float = 0.0,
    rate: float = 1.0,
) -> list[dict[str, Any]]:
    """All trials, those that are on disk already read from there; with ``minutes`` no new one is begun after so
    long; rate: of the laboratory's clock."""
    wanted = [(case.name, seed + k) for k in range(count) for case in scenario.cases if not objects or case.name in objects]
    out.mkdir(parents=True, exist_ok=True)
    records: dict[tuple[str, int], dict[str, Any]] = {}
    for case, number in wanted:
        path = _path(out, case, number)
        if path.is_file():
            records[case, number] = json.loads(path.read_text())
    missing = [key for key in wanted if key not in records]
    end = time.monotonic() + 60 * minutes if minutes > 0 else np.inf
    if missing:
        with Session(out / "logs", lab={"rate": rate}) as session:
            session.ready()
            for case, number in missing:
                if time.monotonic() > end:
                    break
                record = session.trial(scenario, case, number, out)
                records[case, number] = record
                what = "succeeded" if record["success"] else f"failed at {record['stage']} [{Code(record['code']).name}]: {_reason(record)}"
                say(f"{scenario.name}, {case}, seed {number}: {what} ({record['wall_seconds']:.0f} s)")
    done = [records[key] for key in wanted if key in records]
    (out / "trials.json").write_text(json.dumps({"summary": summary(done), "trials": done}, indent=2) + "\n")
    return done


def _path(out: Path, case: str, seed: int) -> Path:
    return out / f"{case.replace(':', '_').replace(' ', '_')}_{seed}.json"


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``ros2 run magic_lab trials``; status 0 where every trial was done, whatever came of it."""
    parser = argparse.ArgumentParser(prog="trials", description="Trials in the simulated laboratory, judged on the truth.")
    parser.add_argument(
        "--scenario", default="hooking", choices=tuple(SCENARIOS), help="; ".join(f"{s.name}: {s.description}" for s in SCENARIOS.values())
    )
    parser.add_argument("--trials", type=int, default=10, help="with each object (default 10)")
    parser.add_argument("--objects", nargs="+", default=[], metavar="NAME", help="with these objects alone")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial; the next ones have the numbers after it (default 0)")
    parser.add_argument("--out", type=Path, required=True, help="folder for results; what is there already is not done again")
    parser.add_argument(
        "--rate",
        type=float,
        default=1.0,
        help="of the laboratory's clock as a share of the wall's, at most; less where other work shares the machine",
    )
    parser.add_argument("--minutes", type=float, default=0.0, help="begin no trial after so long; 0: all (default)")
    options = parser.parse_args(argv)
    scenario = scenario_of(options.scenario)
    names = [case.name for case in scenario.cases]
    unknown = [name for name in options.objects if name not in names]
    if unknown:
        parser.error(f"object {unknown[0]!r} (allowed: {', '.join(names)})")
    try:
        environment.prepare()
        done = do(scenario, options.trials, options.seed, options.out, options.objects, minutes=options.minutes, rate=options.rate)
    except MagicError as error:
        print(f"trials: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print(told(summary(done)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
