"""The graph as child processes: start, watch, measure, stop.  Imports no rclpy."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from magic_core.errors import Code, MagicError

#: The five processes of the graph: node name -> (package, executable).
NODES: dict[str, tuple[str, str]] = {
    "perception": ("magic_perception", "perception"),
    "matcher": ("magic_matcher", "matcher"),
    "planner": ("magic_planner", "planner"),
    "verifier": ("magic_verifier", "verifier"),
    "strategy_server": ("magic_server", "strategy_server"),
}

#: What the process of a launch file is called.
LAUNCH = "launch"

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)


def _die_with_parent() -> None:
    """In the child: be told to end when the parent ends, however that happens (Linux, prctl(2))."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def executable(package: str, name: str) -> Path:
    """The installed executable of a package, as ``ros2 run`` finds it; raises SERVER_UNAVAILABLE where it is not built."""
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        path = Path(get_package_prefix(package)) / "lib" / package / name
    except PackageNotFoundError:
        raise MagicError(Code.SERVER_UNAVAILABLE, f"package {package!r} is not built", allowed="a workspace built by setup.sh") from None
    if not path.is_file():
        raise MagicError(Code.SERVER_UNAVAILABLE, f"package {package!r} has no executable {name!r}", str(path))
    return path


def peak_memory(pid: int) -> float:
    """The most memory that a process has held so far, MB (VmHWM: resident set, high water mark); 0 where it is gone."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    except OSError:
        pass
    return 0.0


@dataclass
class Process:
    """One child process with its log file."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path
    peak_mb: float = 0.0
    stopped: bool = field(default=False)

    @classmethod
    def start(cls, name: str, command: Sequence[str], log: Path, env: Mapping[str, str] | None = None) -> Process:
        """Start a command in a session of its own, so that an interrupt of the terminal reaches only the parent."""
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "wb") as file:
            popen = subprocess.Popen(
                list(command),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=dict(env) if env is not None else None,
                start_new_session=True,
                preexec_fn=_die_with_parent,
            )
        return cls(name, popen, log)

    def sample(self) -> None:
        """Note the peak of memory so far."""
        if self.popen.poll() is None:
            self.peak_mb = max(self.peak_mb, peak_memory(self.popen.pid))

    @property
    def status(self) -> int | None:
        """The exit status; ``None`` while it runs; negative: ended by that signal."""
        return self.popen.poll()

    def tail(self, lines: int = 12) -> str:
        """The end of its log."""
        try:
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])
        except OSError:
            return ""

    def signal(self, number: int) -> None:
        """Send a signal to the process, if it still runs."""
        if self.popen.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.popen.pid, number)

    def wait(self, timeout: float) -> int | None:
        """Its exit status; ``None`` where it still runs after ``timeout`` seconds."""
        try:
            return self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            return None


class Graph:
    """Processes that belong together; use as a context manager, which stops them all whatever happens."""

    def __init__(self, logs: Path, env: Mapping[str, str]) -> None:
        self.logs = logs
        self.env = dict(env)
        self.processes: dict[str, Process] = {}

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, name: str, package: str, program: str, *args: str) -> Process:
        """Start an installed executable."""
        process = Process.start(name, [str(executable(package, program)), *args], self.logs / f"{name}.log", self.env)
        self.processes[name] = process
        return process

    def start_nodes(
        self,
        parameters: Mapping[str, Mapping[str, object]] | None = None,
        leave_out: Sequence[str] = (),
        files: Mapping[str, Sequence[Path]] | None = None,
    ) -> None:
        """Start the five nodes at once, each with its own parameters files, later ones over earlier ones, and parameters over those."""
        for name, (package, program) in NODES.items():
            if name in leave_out:
                continue
            arguments = [x for path in (files or {}).get(name, ()) for x in ("--params-file", str(path))]
            arguments += [
                x
                for k, v in (parameters or {}).get(name, {}).items()
                for x in ("-p", f"{k}:={str(v).lower() if isinstance(v, bool) else v}")
            ]
            self.start(name, package, program, *(["--ros-args", *arguments] if arguments else []))

    def start_launch(self, arguments: Sequence[str]) -> Process:
        """Start a launch file (its path, then NAME:=VALUE ...) by ``ros2 launch``; it counts as a node: its end is an error."""
        ros2 = shutil.which("ros2", path=self.env.get("PATH"))
        if ros2 is None:
            raise MagicError(Code.SERVER_UNAVAILABLE, "ros2 is not on the PATH", allowed="a shell that has sourced ros2_ws/env.sh")
        process = Process.start(LAUNCH, [ros2, "launch", *arguments], self.logs / f"{LAUNCH}.log", self.env)
        self.processes[LAUNCH] = process
        return process

    def sample(self) -> None:
        """Note every process's peak of memory."""
        for process in self.processes.values():
            process.sample()

    def check(self) -> None:
        """Raise SERVER_UNAVAILABLE naming a node that has ended by itself, with the end of its log."""
        for name, process in self.processes.items():
            if (name in NODES or name == LAUNCH) and not process.stopped and process.status is not None:
                status = process.status
                how = f"exit status {status}" if status >= 0 else f"signal {signal.Signals(-status).name}"
                last = [line for line in process.tail().splitlines() if line.strip()][-1:]
                raise MagicError(Code.SERVER_UNAVAILABLE, f"node {name} has died ({how})" + (f": {last[0].strip()}" if last else ""))

    def peak_memory_mb(self) -> dict[str, float]:
        """Peak of memory by process, MB."""
        return {name: round(p.peak_mb, 1) for name, p in self.processes.items() if p.peak_mb > 0}

    def stop(self, names: Sequence[str] | None = None, patience: float = 8.0) -> dict[str, int | None]:
        """Stop processes together: SIGINT, then SIGTERM, then SIGKILL; returns their exit statuses."""
        chosen = [p for n, p in self.processes.items() if names is None or n in names]
        for process in chosen:
            process.stopped = True
            process.sample()
        for number, seconds in ((signal.SIGINT, patience), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0)):
            for process in chosen:
                process.signal(number)
            deadline = time.monotonic() + seconds
            for process in chosen:
                process.wait(max(0.0, deadline - time.monotonic()))
            if all(p.status is not None for p in chosen):
                break
        return {p.name: p.status for p in chosen}
