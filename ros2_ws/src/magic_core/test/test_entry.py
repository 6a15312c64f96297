"""How executables begin: what is wrong with the environment is said in one line, and Ctrl-C during the imports leaves no traceback."""

import os
import signal
import subprocess
import sys
import time

import pytest

from magic_core import arguments, environment
from magic_core.entry import program, version
from magic_core.errors import Code, MagicError

BEGIN = "import sys; from magic_core.entry import program; sys.exit(program('slow_module')())"


def started(folder, text, **changes):
    (folder / "slow_module.py").write_text(text)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]), "PYTHONUNBUFFERED": "1"}
    env.update({k: v for k, v in changes.items() if v is not None})
    for name in (k for k, v in changes.items() if v is None):
        env.pop(name, None)
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", BEGIN], env=env, stdout=pipe, stderr=pipe, text=True)


def test_an_interrupt_during_the_imports_leaves_no_traceback(tmp_path):
    with started(tmp_path, "import time; print('importing'); time.sleep(60)") as process:
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == -signal.SIGINT
        assert process.stderr.read() == ""


@pytest.mark.parametrize("seconds", [0.02, 0.05, 0.1, 0.2, 0.3])
def test_an_interrupt_while_python_starts_leaves_no_traceback(tmp_path, seconds):
    """As setup.sh makes the installed scripts begin."""
    (tmp_path / "slow_module.py").write_text("import time; time.sleep(60)")
    script = tmp_path / "program"
    # What a script of setuptools does first takes a tenth of a second.
    script.write_text(f"#!/usr/bin/env -S --block-signal=INT {sys.executable}\nimport importlib.metadata\n{BEGIN}\n")
    script.chmod(0o755)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    with subprocess.Popen([str(script)], env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=20)
        assert (process.returncode, said) == (-signal.SIGINT, "")


def test_an_interrupt_after_the_imports_is_the_programs_own(tmp_path):
    text = "import time\ndef main():\n try:\n  print('at work'); time.sleep(60)\n except KeyboardInterrupt:\n  return 7\n"
    with started(tmp_path, text) as process:
        assert process.stdout.readline() == "at work\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 7


def test_a_middleware_that_is_not_installed_is_said_in_one_line(tmp_path):
    with started(tmp_path, "print('imported')", RMW_IMPLEMENTATION="rmw_none_cpp") as process:
        assert process.wait(20) == 1
        assert process.stdout.read() == ""
        said = process.stderr.read()
    assert len(said.splitlines()) == 1 and "rmw_none_cpp" in said and "rmw_fastrtps_cpp" in said and "unset RMW_IMPLEMENTATION" in said


def test_ros_starts_without_a_home(tmp_path):
    text = "import rclpy, os\ndef main():\n rclpy.init(); print(os.environ['HOME'])\n"
    with started(tmp_path, text, HOME=None, ROS_HOME=None, ROS_LOG_DIR=None) as process:
        assert process.wait(30) == 0, process.stderr.read()
        assert process.stdout.read().startswith("/")


def test_installed_middlewares_are_found_by_the_index(tmp_path, monkeypatch):
    index = tmp_path / "share/ament_index/resource_index/rmw_typesupport"
    index.mkdir(parents=True)
    for name in ("rmw_a_cpp", "rmw_b_cpp", "rmw_implementation"):
        (index / name).touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert environment.middlewares() == ["rmw_a_cpp", "rmw_b_cpp"]
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_b_cpp")
    environment.prepare()
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_c_cpp")
    with pytest.raises(MagicError) as caught:
        environment.prepare()
    assert caught.value.code is Code.BAD_REQUEST


@pytest.mark.parametrize(
    "words, own, ros",
    [
        ("bag -m /a:=/b", "bag -m /a:=/b", ""),
        ("bag -m /a:=/b --ros-args -r /c:=/d", "bag -m /a:=/b", "--ros-args -r /c:=/d"),
        ("--ros-args -p x:=1 -- bag --loop", "bag --loop", "--ros-args -p x:=1 --"),
        ("", "", ""),
    ],
)
def test_command_lines_are_parted(words, own, ros):
    assert arguments.split(words.split()) == (own.split(), ros.split())


def test_the_version_is_told_without_the_imports(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["anything", "--version"])
    assert program("magic_core.no_such_module")() == 0
    name, number = capsys.readouterr().out.split()
    assert name == "magic_core" and number == version() and number[0].isdigit()


def test_a_reader_that_has_gone_leaves_no_traceback(tmp_path):
    """As ``program | head`` does."""
    text = "def main():\n for number in range(100000):\n  print(number)\n"
    with started(tmp_path, text, PYTHONUNBUFFERED=None) as process:
        assert process.stdout.readline() == "0\n"
        process.stdout.close()
        assert process.wait(20) == 128 + signal.SIGPIPE
        assert process.stderr.read() == ""
