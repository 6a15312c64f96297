"""``ros2 launch``: starts what an XML launch file asks for, passes signals on, and says which process ended how."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magic_ros2cli import launch_file
from magic_ros2cli.errors import CommandError
from magic_ros2cli.launch_file import Process

#: From SIGINT to SIGTERM, and from SIGTERM to SIGKILL, s; launch's own defaults.
ESCALATION = 5.0

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_PDEATHSIG = 1


def launch(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 launch", description="Run a launch file")
    parser.add_argument("-n", "--noninteractive", action="store_true", help="run as if no terminal were there")
    parser.add_argument("-d", "--debug", action="store_true", help="say more about what is started")
    parser.add_argument("-p", "--print", "--print-description", action="store_true", dest="show", help="print what would be started")
    parser.add_argument("-s", "--show-args", "--show-arguments", action="store_true", help="show the arguments of the launch file")
    parser.add_argument("package_name", help="name of the ROS package, or path of a launch file")
    parser.add_argument("launch_file_name", nargs="?", help="name of the launch file")
    parser.add_argument("launch_arguments", nargs="*", help="arguments as '<name>:=<value>'")
    parsed = parser.parse_args(arguments)
    rest = list(parsed.launch_arguments)
    if parsed.launch_file_name and ":=" not in parsed.launch_file_name:
        path = launch_file.find(parsed.package_name, parsed.launch_file_name)
    else:
        path = Path(parsed.package_name)
        if parsed.launch_file_name:
            rest.insert(0, parsed.launch_file_name)
        if not path.is_file():
            raise CommandError(f"launch file '{parsed.package_name}' was not found (allowed: a path, or a package and a file's name)")
    if path.suffix != ".xml":
        raise CommandError(f"cannot launch {path.name} (allowed: XML launch files, *.xml)")
    given = {}
    for text in rest:
        name, separator, value = text.partition(":=")
        if not separator or not name:
            raise CommandError(f"malformed launch argument '{text}', expected format '<name>:=<value>'")
        given[name] = value
    if parsed.show_args:
        print(describe(launch_file.parse(path, given, declared_only=True).arguments))
        return 0
    description = launch_file.parse(path, given)
    for name in given:
        if name not in {a.name for a in description.arguments}:
            print(f"[WARNING] [launch]: the launch file has no argument '{name}'", file=sys.stderr)
    if parsed.show:
        for process in description.processes:
            print(" ".join([process.label + ":", *process.command, *process.ros_arguments]))
        return 0
    return Launcher(description.processes, description.messages, parsed.debug).run()


def describe(arguments: list[launch_file.Argument]) -> str:
    """The text of ``--show-args``."""
    lines = ["Arguments (pass arguments as '<name>:=<value>'):"]
    for argument in arguments:
        choices = f" Valid choices are: {list(argument.choices)}" if argument.choices else ""
        lines += ["", f"    '{argument.name}':{choices}", f"        {argument.description or 'no description given'}"]
        if argument.default is not None:
            lines.append(f"        (default: {argument.default!r})")
    if not arguments:
        lines += ["", "  No arguments."]
    return "\n".join(lines)


@dataclass
class _Running:
    process: Process
    label: str
    child: subprocess.Popen[bytes] | None = None
    readers: list[threading.Thread] = field(default_factory=list)
    start_at: float = 0.0  # of a respawn, monotonic s
    ended: bool = False


class Launcher:
    """Runs processes until all have ended or SIGINT or SIGTERM comes; see :meth:`run`."""

    def __init__(self, processes: list[Process], messages: list[str] | None = None, debug: bool = False) -> None:
        self._running = [_Running(p, f"{p.label}-{i + 1}") for i, p in enumerate(processes)]
        self._messages = messages or []
        self._debug = debug
        self._signals: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._print_lock = threading.Lock()
        self._status = 0
        self._stopping_since: float | None = None
        self._sent = 0

    def run(self) -> int:
        """0 where every process ended with status 0 or because it was told to; 1 where one failed by itself."""
        home = Path(os.environ.get("ROS_LOG_DIR") or Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "log")
        stamp = time.strftime("%Y-%m-%d-%H-%M-%S")
        self._log_folder = home / f"{stamp}-{os.uname().nodename}-{os.getpid()}"
        self._log_folder.mkdir(parents=True, exist_ok=True)
        self._temporary = Path(tempfile.mkdtemp(prefix="launch_params_"))
        before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._say("INFO", "launch", f"All log files can be found below {self._log_folder}")
            self._say("INFO", "launch", "Default logging verbosity is set to " + ("DEBUG" if self._debug else "INFO"))
            for message in self._messages:
                self._say("INFO", "launch.user", message)
            for running in self._running:
                self._start(running)
            while not all(r.ended for r in self._running):
                self._step()
        finally:
            for running in self._running:
                if running.child is not None and running.child.poll() is None:
                    self._signal(running, signal.SIGKILL)
                    running.child.wait()
            for number, handler in before.items():
                signal.signal(number, handler)
            shutil.rmtree(self._temporary, ignore_errors=True)
        return self._status

    # ------------------------------------------------------------------------------------------ one round
    def _step(self) -> None:
        while not self._signals.empty():
            self._interrupted(self._signals.get())
        now = time.monotonic()
        if self._stopping_since is not None:
            waited = now - self._stopping_since
            if waited > ESCALATION and self._sent < 2:
                self._send(signal.SIGTERM, 2)
            elif waited > 2 * ESCALATION and self._sent < 3:
                self._send(signal.SIGKILL, 3)
        for running in self._running:
            if running.ended:
                continue
            if running.child is None:
                if self._stopping_since is not None:
                    running.ended = True
                elif now >= running.start_at:
                    self._start(running)
            elif running.child.poll() is not None:
                self._finished(running)
        if not all(r.ended for r in self._running):
            time.sleep(0.02)

    def _on_signal(self, number: int, _frame: Any) -> None:
        self._signals.put(number)

    def _interrupted(self, number: int) -> None:
        name = signal.Signals(number).name
        if self._stopping_since is not None:
            self._say("WARNING", "launch", f"{name} received again, ignoring...")
            return
        self._say("WARNING", "launch", "user interrupted with ctrl-c (SIGINT)" if number == signal.SIGINT else "SIGTERM received")
        self._shutdown()

    def _shutdown(self) -> None:
        self._stopping_since = time.monotonic()
        self._send(signal.SIGINT, 1)

    def _send(self, number: int, stage: int) -> None:
        self._sent = stage
        for running in self._running:
            if running.child is not None and not running.ended and running.child.poll() is None:
                level = "INFO" if stage == 1 else "ERROR"
                if stage > 1:
                    self._say(
                        level,
                        running.label,
                        f"process[{running.label}] failed to terminate '{ESCALATION * (stage - 1):.0f}' seconds after SIGINT",
                    )
                self._say(level, running.label, f"sending signal '{signal.Signals(number).name}' to process[{running.label}]")
                self._signal(running, number)

    @staticmethod
    def _signal(running: _Running, number: int) -> None:
        # SIGINT and SIGTERM to the process alone, as launch does; SIGKILL to whatever it has started as well.
        try:
            if number == signal.SIGKILL:
                os.killpg(running.child.pid, number)
            else:
                running.child.send_signal(number)
        except (ProcessLookupError, PermissionError):
            pass

    # ------------------------------------------------------------------------------------------ one process
    def _start(self, running: _Running) -> None:
        process = running.process
        command = [*process.command, *self._ros_arguments(running)]
        environment = {**os.environ, **dict(process.environment)}
        parent = os.getpid()

        def in_child() -> None:
            # No process outlives a launch that was killed.
            _LIBC.prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
            if os.getppid() != parent:
                os._exit(1)

        try:
            # A session of its own: Ctrl-C in the terminal reaches the process once, through this launcher.
            running.child = subprocess.Popen(
                command,
                env=environment,
                cwd=process.directory or None,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
                preexec_fn=in_child,
            )
        except (OSError, subprocess.SubprocessError) as error:
            running.ended = True
            self._status = 1
            self._say("ERROR", running.label, f"process could not be started: {error}")
            if process.ends_launch and self._stopping_since is None:
                self._shutdown()
            return
        self._say("INFO", running.label, f"process started with pid [{running.child.pid}]")
        running.readers = []
        for stream, on_screen in (
            (running.child.stdout, process.output in ("screen", "both")),
            (running.child.stderr, process.output != "own_log"),
        ):
            reader = threading.Thread(target=self._copy, args=(running.label, stream, on_screen), daemon=True)
            reader.start()
            running.readers.append(reader)

    def _ros_arguments(self, running: _Running) -> list[str]:
        process = running.process
        if not process.is_node:
            return []
        result = list(process.ros_arguments)
        for index, parameters in enumerate(process.parameters):
            path = parameters.file
            if not path:
                import yaml

                path = str(self._temporary / f"{running.label}_{index}.yaml")
                content = {"/**": {"ros__parameters": {parameters.name: parameters.value}}}
                Path(path).write_text(parameters.text or yaml.safe_dump(content))
            result += ["--params-file", path]
        return ["--ros-args", *result] if result else []

    def _finished(self, running: _Running) -> None:
        for reader in running.readers:
            reader.join(timeout=1.0)
        child, process = running.child, running.process
        code = child.returncode
        stopping = self._stopping_since is not None
        if code == 0 or (stopping and self._sent < 3 and code in (-signal.SIGINT, -signal.SIGTERM)):
            self._say("INFO", running.label, f"process has finished cleanly [pid {child.pid}]")
        else:
            self._say("ERROR", running.label, f"process has died [pid {child.pid}, exit code {code}, cmd '{' '.join(child.args)}'].")
            self._status = 1
        running.child = None
        if process.respawn and not stopping:
            running.start_at = time.monotonic() + process.respawn_delay
            return
        running.ended = True
        if process.ends_launch and not stopping:
            self._shutdown()

    def _copy(self, label: str, stream: Any, on_screen: bool) -> None:
        """Lines of a process to the screen, prefixed, and to its log file."""
        with stream, open(self._log_folder / f"{label}.log", "ab", buffering=0) as log:
            for line in stream:
                log.write(line)
                if on_screen:
                    self._line(f"[{label}] {line.decode(errors='replace').rstrip()}")

    def _say(self, level: str, who: str, message: str) -> None:
        line = f"[{level}] [{who}]: {message}"
        self._line(line)
        with open(self._log_folder / "launch.log", "a") as log:
            log.write(f"{time.time():.7f} {line}\n")

    def _line(self, line: str) -> None:
        with self._print_lock, contextlib.suppress(BrokenPipeError, ValueError):
            print(line, flush=True)
