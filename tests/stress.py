"""The whole graph under faults, for longer than a test may take: many requests, broken messages and bags, starts and stops, kills.

    source ros2_ws/env.sh
    python tests/stress.py [PART ...] [--quick] [--seed N] [--out DIR]

Parts, each of which may be run alone:

    requests   10,000 random requests to matcher, planner, verifier and strategy server: each is answered, none by INTERNAL
    messages   300 mangled messages to perception: it goes on, and sees the objects in good ones afterwards
    bags       200 mangled bags: each is read or refused by BAD_BAG
    goals      300 runs of a strategy from a recorded bag, every tenth with the arm and its pictures: each is answered in its time,
               those with the floating gripper are verified, the same goal has the same answer, and no process grows
    starts     50 starts and stops of the graph, at random moments of its start: every process ends by itself and in order, and
               leaves nothing behind
    kills      each node killed while a run is at each stage: an answer within 5 s, and the next run works

A process grows where its memory, its children's with it, has a slope over the cases after the warm-up that is above what is called
flat below: the median of the slopes between any two cases, which single outliers do not move.  A step that stays does, where it comes
in the middle.

What is done is kept in ``--out`` after every case; the same command goes on where it was interrupted.  It ends with a table of what is
done so far, also where it is interrupted (SIGINT, SIGTERM; status 130), and with status 1 where something did not hold.  ``--quick``: a
twentieth of each part.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from magic_bags import bag_file
from magic_bringup.demo import Options
from magic_bringup.graph import NODES, Graph
from magic_bringup.testing import Bench, Feed, camera_messages, feeding, first_messages, started, until
from magic_core import conversions, shapes, transforms
from magic_core.domain import isolated
from magic_core.errors import Code, MagicError
from magic_server.testing import fakes

ROOT = Path(__file__).resolve().parents[1]
#: How many cases each part has.
SIZES = {"requests": 10_000, "messages": 300, "bags": 200, "goals": 300, "starts": 50, "kills": 25}
#: Longest wait for any one answer, s.
DEADLINE = 60.0
#: For one run, s: many times what one with the arm takes on two cores (some 5 s), and less than a test's client waits.
RUN_LIMIT = 120.0
#: From a kill to the answer, s.
KILL_LIMIT = 5.0
#: Flat is a slope below this, MB a case; and from which case on it is taken: of the goals from the middle on, as one in ten alone is with
#: the arm and its pictures, which take most and reach their most late.
FLAT = {"requests": 0.002, "messages": 0.05, "goals": 0.05}
WARM_UP = {"requests": 1000, "messages": 50, "goals": 150}
#: Between two measurements of memory, cases; with fewer of them than this nothing is said about growth.
MEASURED_EVERY, ENOUGH = {"requests": 20, "messages": 1, "goals": 1, "kills": 1}, 100
STAGES = ("perceive", "match", "plan", "verify", "execute")
#: Of a strategy server whose arm is a stand-in.
SERVER_PARAMETERS = {
    "execute": True,
    "autostart": True,
    "state_age": 10.0,
    "objects_age": 3600.0,
    "start_tolerance": 0.5,
    "trajectory_action": "arm/follow_joint_trajectory",
    "gripper_action": "gripper/gripper_action",
    **fakes.OPEN_LOOP,
}


class Part:
    """The cases of one part that are done: ``cases[i]`` is what went wrong in the i-th, empty where nothing did."""

    def __init__(self, name: str, size: int, seed: int, out: Path) -> None:
        self.name, self.size, self.seed = name, size, seed
        self.path = out / f"{name}_{size}_{seed}.json"
        self.cases: list[str] = []
        self.kinds: Counter[str] = Counter()
        self.memory: list[list[tuple[int, dict[str, float]]]] = []  # by graph: after how many cases of it, MB by process
        self.seconds = 0.0
        self.worst = 0.0
        if self.path.is_file():
            stored = json.loads(self.path.read_text())
            self.cases, self.memory = stored["cases"], stored["memory"]
            self.kinds, self.seconds, self.worst = Counter(stored["kinds"]), stored["seconds"], stored["worst"]
        self.begin()
        self._saved = self._said = 0.0

    def begin(self) -> None:
        """The clock of the part runs from here on."""
        self._began = time.monotonic()

    @property
    def left(self) -> Iterator[tuple[int, random.Random]]:
        """Number and own random numbers of each case that is not done yet."""
        while len(self.cases) < self.size:
            index = len(self.cases)
            yield index, random.Random(f"{self.name} {self.seed} {index}")

    def done(self, wrong: str = "", kind: str = "", seconds: float = 0.0) -> None:
        """Note a case."""
        self.cases.append(wrong)
        self.kinds[kind or ("wrong" if wrong else "right")] += 1
        self.worst = max(self.worst, seconds)
        if wrong:
            say(f"{self.name} {len(self.cases)}: {wrong}")
        if time.monotonic() - self._saved > 5.0 or len(self.cases) == self.size:
            self.save()

    def save(self) -> None:
        """Keep what is done."""
        now = time.monotonic()
        self.seconds += now - self._began
        self._began = self._saved = now
        content = {k: getattr(self, k) for k in ("name", "size", "seed", "cases", "memory", "seconds", "worst")}
        temporary = self.path.with_suffix(".tmp")
        temporary.write_text(json.dumps({**content, "kinds": dict(self.kinds)}, indent=1))
        temporary.replace(self.path)
        if now - self._said > 30.0 or len(self.cases) == self.size:
            self._said = now
            say(f"{self.name}: {len(self.cases)} of {self.size}, {sum(map(bool, self.cases))} wrong")

    def measure(self, graph: Graph) -> None:
        """Note what the processes of a graph hold; to be called after each case."""
        if len(self.cases) % MEASURED_EVERY[self.name] == 0 or len(self.cases) == self.size:
            self.memory[-1].append((len(self.cases), held(graph)))

    def growth(self) -> list[dict[str, Any]]:
        """By graph: its cases from the warm-up on, and by process MB first and last (means of a tenth) and MB a case, none where unsaid."""
        found = []
        for series in self.memory:
            steady = [(case, mb) for case, mb in series if case >= series[0][0] + WARM_UP.get(self.name, 0)] if series else []
            if not steady:
                continue
            cases = np.array([case for case, _ in steady], float)
            nodes = {}
            for name in NODES:
                held_mb = np.array([mb.get(name, np.nan) for _, mb in steady])
                if np.isnan(held_mb).all():
                    continue
                tenth = max(1, len(held_mb) // 10)
                one, other = np.triu_indices(len(cases), 1)
                slopes = (held_mb[other] - held_mb[one]) / (cases[other] - cases[one])
                slope = float(np.nanmedian(slopes)) if len(cases) >= ENOUGH and self.name in FLAT else None
                nodes[name] = (float(np.nanmean(held_mb[:tenth])), float(np.nanmean(held_mb[-tenth:])), slope)
            found.append({"from": int(cases[0]), "to": int(cases[-1]), "nodes": nodes})
        return found

    @property
    def grown(self) -> list[str]:
        """The processes that are not flat."""
        return [
            f"{self.name}: {name} grows by {slope:.3f} MB a case (allowed: {FLAT[self.name]})"
            for entry in self.growth()
            for name, (_, _, slope) in entry["nodes"].items()
            if slope is not None and slope >= FLAT[self.name]
        ]


def say(line: str) -> None:
    print(f"[{time.strftime('%H:%M:%S')}] {line}", flush=True)


def held(graph: Graph) -> dict[str, float]:
    """Resident memory by node, MB, with that of the processes that it has started."""
    return {
        name: round(sum(map(resident, family(process.popen.pid))), 1)
        for name, process in graph.processes.items()
        if name in NODES and process.status is None
    }


def family(pid: int) -> list[int]:
    """A process and all that came of it."""
    found = [pid]
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += family(int(child))
    return found


def resident(pid: int) -> float:
    """Resident memory of a process, MB; 0 where it is gone."""
    with contextlib.suppress(OSError):
        if match := re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text()):
            return int(match[1]) / 1024
    return 0.0


@contextlib.contextmanager
def marked() -> Iterator[Callable[[], list[str]]]:
    """What is started inside carries a mark: the function gives the command lines of what of it still runs."""
    mark = f"MAGIC_STRESS={os.getpid()}.{time.monotonic_ns()}"
    name, _, value = mark.partition("=")
    os.environ[name] = value

    def running() -> list[str]:
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if mark.encode() in (folder / "environ").read_bytes().split(b"\0") and int(folder.name) != os.getpid():
                    found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()[-120:])
        return found

    try:
        yield running
    finally:
        os.environ.pop(name, None)


# ------------------------------------------------------------------------------------------------ mangling

FLOATS = (0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf"), float("-inf"), 1e-3, 1e3)
TEXTS = ("", " ", "x" * 5000, "../../etc/passwd", "/", "~", "é\n", "hooking", "object_1", "arm", "keep", "fg", "%s{}$(x)", "None")
RANGES = {"int8": (-(2**7), 2**7 - 1), "uint8": (0, 2**8 - 1), "int16": (-(2**15), 2**15 - 1), "uint16": (0, 2**16 - 1)}
RANGES |= {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1), "int64": (-(2**63), 2**63 - 1), "uint64": (0, 2**64 - 1)}


def mangle(message: Any, rng: random.Random) -> str:
    """Change one thing somewhere in a message; its path."""
    fields = message.get_fields_and_field_types()
    if not fields:
        return ""
    name = rng.choice(list(fields))
    kind, value = fields[name], getattr(message, name)
    return f"{name}{_mangled(message, name, kind, value, rng)}"


def _mangled(message: Any, name: str, kind: str, value: Any, rng: random.Random) -> str:
    if hasattr(value, "get_fields_and_field_types"):
        return "." + mangle(value, rng)
    if isinstance(value, bool):
        setattr(message, name, not value)
    elif isinstance(value, str):
        setattr(message, name, rng.choice(TEXTS))
    elif isinstance(value, float):
        setattr(message, name, rng.choice([*FLOATS, -value, value * 1000, value / 1000, value + 1]))
    elif isinstance(value, int):
        low, high = RANGES.get(kind, (0, 255))
        setattr(message, name, min(max(rng.choice([low, high, 0, 1, value + 1, value - 1]), low), high))
    elif isinstance(value, np.ndarray):
        changed = value.copy()
        whole = np.issubdtype(changed.dtype, np.integer)
        changed[rng.randrange(len(changed))] = rng.choice((0, 1, np.iinfo(changed.dtype).max) if whole else FLOATS)
        setattr(message, name, changed)
    elif hasattr(value, "__len__") and not isinstance(value, bytes):
        return _mangled_list(message, name, kind, value, rng)
    return ""


def _mangled_list(message: Any, name: str, kind: str, value: Any, rng: random.Random) -> str:
    if len(value) and rng.random() < 0.6:
        index = rng.randrange(len(value))
        element = value[index]
        if hasattr(element, "get_fields_and_field_types"):
            return f"[{index}].{mangle(element, rng)}"
        if isinstance(element, float):
            value[index] = rng.choice(FLOATS)
        elif isinstance(element, int):
            low, high = RANGES.get(kind.split("<")[-1].strip(">"), (0, 255))
            value[index] = rng.choice((low, high, 0))
        elif isinstance(element, str):
            value[index] = rng.choice(TEXTS)
        return f"[{index}]"
    changed = value[: rng.randrange(len(value) + 1)] if rng.random() < 0.7 else value + value[:1]
    with contextlib.suppress(AssertionError):  # of a fixed length
        setattr(message, name, changed)
    return f"[:{len(changed)}]"


# ------------------------------------------------------------------------------------------------ requests


def requests(part: Part, logs: Path) -> None:
    """Good requests with one to four things in them changed, from a seed each."""
    from magic_core.actions import ActionClient
    from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
    from magic_interfaces.srv import MatchContact

    if len(part.cases) >= part.size:
        return
    parameters = {"strategy_server": {"objects_timeout": 0.5, "timeout": 20.0}}
    with started(logs, parameters=parameters, leave_out=("perception",)) as bench:
        node = bench.watcher.node
        scene = conversions.scene_to_msg(small_scene())
        publisher = fakes.FakeServers("objects", services=("objects",))
        publisher._objects.publish(scene)
        bench.ready(tuple(n for n in NODES if n != "perception"))
        match = node.create_client(MatchContact, "match_contact")
        actions = {
            kind: ActionClient(node, kind, name)
            for kind, name in ((PlanMotion, "plan_motion"), (VerifyMotion, "verify_motion"), (RunStrategy, "run_strategy"))
        }
        until(lambda: match.service_is_ready() and all(a.server_is_ready() for a in actions.values()), what="the servers are seen")

        def ask(kind: Any, request: Any) -> Any:
            if kind is MatchContact:
                future = match.call_async(request)
                until(future.done, DEADLINE, "the matcher answers")
                return future.result()
            sending = actions[kind].send_goal_async(request)
            until(sending.done, DEADLINE, "the goal is accepted")
            future = sending.result().get_result_async()
            until(future.done, DEADLINE, "the goal ends")
            return future.result().result

        good = good_requests(scene, ask)
        part.memory.append([])
        for _, rng in part.left:
            kind = rng.choices(list(good), (4, 3, 2, 1))[0]
            request = clone(good[kind])
            paths = [mangle(request, rng) for _ in range(rng.randint(1, 4))]
            if hasattr(request, "repetitions"):
                request.repetitions = min(request.repetitions, 2)
            began = time.monotonic()
            try:
                answer = ask(kind, request)
                code = answer.code
                wrong = "" if code in list(Code) and code != Code.INTERNAL else f"{code}: {answer.message}"
            except AssertionError as error:
                code, wrong = -1, str(error)
            if wrong:
                wrong = f"{kind.__name__} {paths}: {wrong}"
            part.done(wrong, Code(code).name if code in list(Code) else str(code), time.monotonic() - began)
            part.measure(bench.graph)
            bench.graph.check()
        part.save()
        publisher.destroy_node()


def small_scene() -> Any:
    """A hook and a cylinder on the table, as perception would tell them."""
    from magic_core.scene import Scene

    tool, target = shapes.make("l_hook", 1), shapes.make("cylinder", 1)
    low = transforms.make(translation=[0.45, -0.1, -tool.mesh.bounds[0, 2]])
    other = transforms.make(translation=[0.55, 0.15, -target.mesh.bounds[0, 2]])
    return Scene((tool.as_object("object_1", low, "top"), target.as_object("object_2", other, "top")), np.array([0.0, 0.0, 1.0, 0.0]))


def good_requests(scene: Any, ask: Callable[[Any, Any], Any]) -> dict[Any, Any]:
    """One request of each kind that succeeds; those after the first from the answers of those before."""
    from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
    from magic_interfaces.srv import MatchContact

    match = MatchContact.Request(strategy="hooking", tool_ids=["object_1"], target_id="object_2", top_k=2)
    # The objects may reach the matcher after the first request.
    matched = until(lambda: found if (found := ask(MatchContact, match)).code != Code.UNKNOWN_OBJECT else None, what="the matcher knows")
    tool, target = scene.objects
    plan = PlanMotion.Goal(strategy="hooking", variant="fg", tool=tool, target=target, table=scene.table, timeout=DEADLINE)
    plan.candidate = matched.candidates[0]
    planned = ask(PlanMotion, plan)
    assert matched.code == planned.code == Code.OK, f"{matched.message}; {planned.message}"
    plan.timeout = 2.0
    verify = VerifyMotion.Goal(strategy="hooking", tool=tool, target=target, table=scene.table, timeout=2.0)
    verify.candidate, verify.plan = matched.candidates[0], planned.plan
    run = RunStrategy.Goal(strategy="hooking", variant="fg", tool_id="object_1", target_id="object_2", timeout=10.0)
    return {MatchContact: match, PlanMotion: plan, VerifyMotion: verify, RunStrategy: run}


def clone(message: Any) -> Any:
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


# ------------------------------------------------------------------------------------------------ messages and bags


def messages(part: Part, logs: Path) -> None:
    """One mangled message of a camera, of TF or of the fixtures at a time, then good ones."""
    from magic_interfaces.msg import SceneObjectArray

    if len(part.cases) >= part.size:
        return
    tool, target = shapes.make("l_hook", 1).mesh, shapes.make("cylinder", 1).mesh
    tool = tool.transformed(transforms.make(translation=[0.45, 0.0, -tool.bounds[0, 2]]))
    target = target.transformed(transforms.make(translation=[0.6, 0.15, -target.bounds[0, 2]]))
    good = camera_messages([tool, target], ("left",))
    good["/known_objects"] = conversions.scene_to_msg(fakes.scene(("rod",)))
    good["/known_objects"].objects[0].pose.position.y = -0.5
    parameters = {"perception": {"cameras": "[left]", "rate": 5.0}}
    with started(logs, parameters=parameters, leave_out=tuple(n for n in NODES if n != "perception")) as bench:
        bench.ready(("perception",))
        latest: dict[str, Any] = {}

        def hear(message: Any) -> None:
            latest["scene"], latest["at"] = message, time.monotonic()

        from magic_core import qos

        bench.watcher.node.create_subscription(SceneObjectArray, "objects", hear, qos.LATCHED)
        feed = Feed(good, lambda topic, message: message)

        def count() -> int:
            return sum(o.source == "camera" for o in latest["scene"].objects)

        def known() -> bool:
            feed._tick()
            time.sleep(0.1)
            return "scene" in latest and count() > 0

        until(known, DEADLINE, "objects are seen")
        wanted = count()
        part.memory.append([])
        for _, rng in part.left:
            topic = rng.choice(list(good))
            broken = clone(good[topic])
            paths = [mangle(broken, rng) for _ in range(rng.randint(1, 3))]
            publisher = next(p for t, _, p, _ in feed._out if t == topic)
            with contextlib.suppress(AssertionError):
                publisher.publish(broken)
            began = time.monotonic()
            for _, message, publisher, _ in feed._out:  # the latched ones, too: what was mangled is mended
                if hasattr(message, "header"):
                    message.header.stamp = feed.get_clock().now().to_msg()
                publisher.publish(message)

            def seen() -> bool:
                feed._tick()
                bench.graph.check()
                time.sleep(0.1)
                return latest.get("at", 0.0) > began and count() == wanted

            wrong = ""
            try:
                until(seen, DEADLINE, f"{wanted} objects are seen again")
            except (AssertionError, MagicError) as error:
                wrong = f"{topic} {paths}: {error}"
            part.done(wrong, topic.rpartition("/")[2], time.monotonic() - began)
            part.measure(bench.graph)
        part.save()
        feed.destroy_node()


def bags(part: Part, logs: Path) -> None:
    """Bytes changed, taken out, put in, cut off: a bag is read or refused."""
    data = (ROOT / "bags/hooking/hooking.mcap").read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mangled.mcap"
        for _, rng in part.left:
            broken = bytearray(data)
            what = rng.choice(("cut", "flip", "hole", "insert", "head"))
            if what == "cut":
                del broken[rng.randrange(len(broken)) :]
            elif what == "hole":
                start = rng.randrange(len(broken))
                del broken[start : start + rng.randrange(1, 5000)]
            elif what == "insert":
                start = rng.randrange(len(broken))
                broken[start:start] = rng.randbytes(rng.randrange(1, 100))
            else:
                for _ in range(rng.randrange(1, 30)):
                    broken[rng.randrange(200 if what == "head" else len(broken))] = rng.randrange(256)
            path.write_bytes(broken)
            wrong, kind = "", "read"
            try:
                with bag_file.open_bag(path) as reader:
                    kind = "read, cut off" if bag_file.note_on(reader) else "read"
                    for _ in reader.messages():
                        pass
            except MagicError as error:
                kind = error.code.name
                wrong = "" if error.code == Code.BAD_BAG else str(error)
            except Exception as error:
                kind, wrong = "exception", f"{what}: {type(error).__name__}: {error}"
            part.done(wrong, kind)


# ------------------------------------------------------------------------------------------------ goals


def goals(part: Part, logs: Path) -> None:
    """The strategy of a recorded bag again and again, with a few seeds in turn.  The scene stays, so that an answer has to come again."""
    if len(part.cases) >= part.size:
        return
    bag = ROOT / "bags/hooking"
    answers: dict[tuple[str, int], tuple[Code, Any]] = {}
    with started(logs, bag) as bench:
        bench.ready()
        bench.play(bag)
        part.memory.append([])
        for index, _ in part.left:
            variant, seed = ("arm", index // 10 % 5) if index % 10 == 9 else ("fg", index % 10)
            began = time.monotonic()
            result = bench.run(strategy="hooking", variant=variant, seed=seed, timeout=RUN_LIMIT, pictures=variant == "arm")
            code = Code(result.code)
            answer = code, motion(result.plan)
            wrong = result.message if code in UNANSWERED or (variant == "fg" and not result.verified) else ""
            if not wrong and answers.setdefault((variant, seed), answer) != answer:
                wrong = f"{variant}, seed {seed}: {code.name}, {answers[variant, seed][0].name} before, or another motion"
            part.done(wrong, f"{variant} {code.name}", time.monotonic() - began)
            part.measure(bench.graph)
            bench.graph.check()
            if index % 50 == 49:
                say(f"goals: {index + 1}: MB {held(bench.graph)}")
        part.save()


#: A goal that ends so has had no answer.
UNANSWERED = {Code.INTERNAL, Code.SERVER_TIMEOUT, Code.SERVER_UNAVAILABLE, Code.SIMULATION_TIMEOUT, Code.PLANNING_TIMEOUT, Code.STALE_DATA}


def motion(plan: Any) -> tuple[Any, ...]:
    """The trajectories of a plan, without the moment at which they were made."""
    return plan.tool_trajectory.points, plan.arm_trajectory.points


# ------------------------------------------------------------------------------------------------ starts and kills


def starts(part: Part, logs: Path) -> None:
    """The five nodes started at once and told to end at a random moment: all have to end in order, whatever they were at."""
    for index, rng in part.left:
        with marked() as running, Graph(logs / str(index), isolated()) as graph:
            began = time.monotonic()
            graph.start_nodes()
            time.sleep(rng.choice((rng.uniform(0.5, 4.0), rng.uniform(4.0, 15.0))))
            number = rng.choice((signal.SIGINT, signal.SIGTERM))
            for process in graph.processes.values():
                process.stopped = True
                process.signal(number)
            wrong = []
            for name, process in graph.processes.items():
                status = process.wait(20.0)
                if status not in (0, -number) or "Traceback" in process.tail(200):
                    wrong.append(f"{name}: status {status}: {process.tail(3)}")
            wrong += left_behind(running)
        part.done("; ".join(wrong), signal.Signals(number).name, time.monotonic() - began)


def left_behind(running: Callable[[], list[str]]) -> list[str]:
    """What does not end by itself within some seconds."""
    try:
        until(lambda: not running(), 10.0)
    except AssertionError:
        return [f"left behind: {'; '.join(running())}"]
    return []


def kills(part: Part, logs: Path) -> None:
    """Each node, killed with SIGKILL at each stage of a run with an arm that is a stand-in."""
    from magic_core.executor import ThreadedExecutor

    if len(part.cases) >= part.size:
        return
    bag = ROOT / "bags/hooking"
    with started(logs, bag, {"strategy_server": SERVER_PARAMETERS}) as bench:
        arm = fakes.FakeArm()
        home = [0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398]
        moving, over = threading.Event(), threading.Event()

        def move(trajectory: Any, canceled: Callable[[], bool]) -> tuple[int, str]:
            moving.set()
            over.wait(10.0)
            return 0, ""

        arm.on_move = move
        executor = ThreadedExecutor(4)
        executor.add_node(arm)
        threading.Thread(target=executor.spin, daemon=True).start()
        bench.ready()
        # As live cameras would: what is played from a bag moves no arm.
        cameras = {topic: message for topic, message in first_messages(bag).items() if topic != "/joint_states"}
        with feeding(cameras):
            until(lambda: bench.watcher.objects_at is not None, what="objects are published")
            part.memory.append([])
            for index, _ in part.left:
                name, stage = list(NODES)[index % 5], STAGES[index // 5 % 5]
                arm.positions = list(home)
                moving.clear()
                over.clear()
                bench.lines.clear()
                code, seconds, children = kill_at(bench, name, stage, moving, over)
                over.set()
                arm.positions = list(home)
                following = after_restart(bench, name)
                wrong = "" if seconds <= KILL_LIMIT else f"{code} after {seconds:.1f} s"
                wrong += "" if following.verified else f"; the next run: {Code(following.code).name}: {following.message}"
                wrong += f"; {len(left)} of its processes are left" if (left := [pid for pid in children if resident(pid)]) else ""
                part.done(wrong and f"{name} killed at {stage}: {wrong}", code, seconds)
                part.measure(bench.graph)
            part.save()
        executor.shutdown(timeout_sec=2.0)
        arm.destroy_node()


def kill_at(bench: Bench, name: str, stage: str, moving: threading.Event, over: threading.Event) -> tuple[str, float, list[int]]:
    """Kill a node when a run says that it is at a stage: how the run ended, after how many seconds, and the processes of the node.

    0 s where nobody missed the node: the run ended well, or by what was seen meanwhile.
    """
    from magic_core import presence

    node = bench.watcher.node
    server = presence.Watch(lambda: presence.servers(node, "/run_strategy/_action/send_goal"))
    pending = bench.watcher.send(Options("hooking", "arm", Path(), Path(), timeout=RUN_LIMIT, pictures=False))
    if stage == "execute":
        until(lambda: moving.is_set() or pending.result is not None, what="the arm moves")
        assert moving.is_set(), f"the run did not come to {stage}: {pending.result.message}"
    else:
        until(lambda: any(line.startswith(stage) for line in bench.lines) or pending.result is not None, what=f"the run is at {stage}")
    process = bench.graph.processes[name]
    children = family(process.popen.pid)[1:]
    process.stopped = True
    process.signal(signal.SIGKILL)
    process.wait(DEADLINE)
    began = time.monotonic()
    over.set()
    # A client hears nothing from a strategy server that has gone: it looks, as `ros2 action send_goal` does.
    until(lambda: pending.result is not None or (name == "strategy_server" and server.gone()), RUN_LIMIT, "the run's client knows")
    code = Code(pending.result.code).name if pending.result is not None else "its server has gone"
    return code, 0.0 if code in (Code.OK.name, Code.STALE_DATA.name) else time.monotonic() - began, children


def after_restart(bench: Bench, name: str) -> Any:
    """Start a node again, wait until it is there, and run."""
    from magic_core import presence

    parameters = {"strategy_server": SERVER_PARAMETERS}
    node = bench.watcher.node
    service = {"matcher": "/match_contact", "strategy_server": "/run_strategy/_action/send_goal"}.get(
        name, f"/{'plan' if name == 'planner' else 'verify'}_motion/_action/send_goal"
    )

    def there() -> frozenset[bytes]:
        return presence.publishers(node, "/objects") if name == "perception" else presence.servers(node, service)

    before = there()
    bench.graph.start_nodes(parameters, leave_out=tuple(n for n in NODES if n != name))
    until(lambda: there() - before, what=f"{name} is there again")
    if name == "perception":
        since = time.monotonic()
        bench.watcher.objects_at = None
        until(lambda: (bench.watcher.objects_at or 0.0) > since, what="objects are published again")
    # On a busy machine a camera's pictures get lost, and what the other one sees alone is another scene: that is said, and asked again.
    for _ in range(3):
        result = bench.run(strategy="hooking", variant="fg", pictures=False)
        if result.code != Code.STALE_DATA:
            break
    return result


# ------------------------------------------------------------------------------------------------ the table


def table(parts: list[Part]) -> str:
    lines = ["| part | cases | not as it should be | longest, s | minutes | outcomes |", "| --- | --- | --- | --- | --- | --- |"]
    for part in parts:
        kinds = ", ".join(f"{k} {n}" for k, n in part.kinds.most_common(8))
        lines.append(
            f"| {part.name} | {len(part.cases)} of {part.size} | {sum(map(bool, part.cases))} | {part.worst:.1f} | {part.seconds / 60:.1f} | {kinds} |"
        )
    lines += ["", "| MB, first to last (kB a case) | " + " | ".join(NODES) + " |", "| --- |" + " --- |" * len(NODES)]
    for part in parts:
        for entry in part.growth():
            cells = []
            for name in NODES:
                first, last, slope = entry["nodes"].get(name, (None, None, None))
                said = "" if slope is None else f" ({slope * 1000:+.1f})"
                cells.append("" if first is None else f"{first:.0f} to {last:.0f}{said}")
            lines.append(f"| {part.name}, cases {entry['from']} to {entry['to']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    """Run parts; 0 where all held."""
    parser = argparse.ArgumentParser(prog="stress.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(SIZES)}; all without it")
    parser.add_argument("--quick", action="store_true", help="a twentieth of each part")
    parser.add_argument("--seed", type=int, default=0, help="of all random choices (default 0)")
    parser.add_argument("--out", type=Path, default=ROOT / "out/stress", help="folder for what is done (default out/stress)")
    given = parser.parse_args()
    unknown = [p for p in given.parts if p not in SIZES]
    if unknown:
        parser.error(f"unknown part {unknown[0]!r}; there are: {', '.join(SIZES)}")
    given.out.mkdir(parents=True, exist_ok=True)
    # A shell that starts this in the background has it ignore SIGINT, and what is started here would inherit that.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    parts = [Part(n, max(1, s // 20) if given.quick else s, given.seed, given.out) for n, s in SIZES.items() if n in (given.parts or SIZES)]
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    failed = interrupted = False
    for part in parts:
        if interrupted:
            break
        say(f"{part.name}: {len(part.cases)} of {part.size} are done")
        part.begin()
        try:
            globals()[part.name](part, given.out / "logs" / part.name)
        except (AssertionError, MagicError) as error:  # the next part is run all the same; this one goes on with the next call
            say(f"{part.name} ended: {error}")
            failed = True
        except KeyboardInterrupt:
            say(f"{part.name} interrupted at {len(part.cases)} of {part.size}; the same command goes on from here")
            interrupted = True
        finally:
            part.save()
    text = table(parts)
    (given.out / "table.md").write_text(text + "\n")
    print(text)
    grown = [line for p in parts for line in p.grown]
    print("\n".join(grown))
    if interrupted:
        return 130
    return int(failed or bool(grown) or any(any(p.cases) for p in parts))


if __name__ == "__main__":
    sys.exit(main())
