"""Every command in the READMEs and the folders docs/ is one that works: quick ones are run, the others go through their own argument
parser.

What a command names has to be there: scripts, packages, executables, launch files and their arguments, parameters, fields of goals, files
of this repository.  Words in capitals stand for the reader's own files.
"""

import argparse
import importlib
import itertools
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from magic_bringup import reference
from magic_bringup.graph import NODES
from magic_perception import parameters as perceived
from magic_ros2cli.main import VERBS
from magic_verifier import cases as evaluated

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "bags/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted(ROOT.glob("magic_*/README.md")),
    *sorted(ROOT.glob("magic_*/docs/*.md")),
    *(path for path in sorted((ROOT / "ros2_ws/src").glob("*/README.md")) if not path.parent.is_symlink()),
]
#: Commands of other packages that a reader has beside these: they are not looked into.
OTHERS = {"ros2 launch realsense2_camera", "ros2 param set", "pip install", "ros2_ws/.venv/bin/pip install", "docker build", "docker run"}
#: What is quick enough to be run as it stands, in a folder of its own.
QUICK = (
    "ros2 run magic_bringup magic strategies",
    "ros2 run magic_bringup calibrate_cameras --draw",
    "bash ros2_ws/demo.sh --help",
)
PLACEHOLDER = re.compile(r"^([A-Z][A-Z_]+|[A-Z][A-Z_]*(\.[a-z]+)+)$")


class ParsedError(Exception):
    """The command line was understood."""


def commands(path):
    """The commands in a document's code blocks: lines joined, comments taken off, what is optional in brackets taken in."""
    found = []
    for language, block in re.findall(r"^ *```(\w*)\n(.*?)^ *```", path.read_text(), re.MULTILINE | re.DOTALL):
        if language in ("", "bash", "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                for part in re.split(r"\s+#\s", line)[0].split(" && "):
                    if part.strip() and not part.strip().startswith("#"):
                        found.append(re.sub(r"\[([^\[\]]*)\]", r"\1", part).strip() if '"' not in part else part.strip())
    return found


ALL = [
    pytest.param(command, id=f"{path.relative_to(ROOT)}: {command[:60]}")
    for path in DOCUMENTS
    if path.name != "reference.md"
    for command in commands(path)
]


@pytest.fixture
def readers(tmp_path):
    """What words in capitals are replaced by: a parameters file for FILE and *.yaml, a folder else."""
    (tmp_path / "FILE.yaml").write_text("/**:\n  ros__parameters: {seed: 0}\n")

    def own(word):
        name, equals, value = word.partition(":=")
        if equals and PLACEHOLDER.match(value):
            return f"{name}:={own(value)}"
        if not PLACEHOLDER.match(word):
            return word
        if word.startswith("FILE") or word.endswith(".yaml"):
            return str(tmp_path / "FILE.yaml")
        if "." in word:
            (tmp_path / word).touch()
            return str(tmp_path / word)
        (tmp_path / word).mkdir(exist_ok=True)
        return str(tmp_path / word)

    return own


def executables():
    """(package, executable) -> module of the program, from every setup.py."""
    found = {}
    for setup in [*ROOT.glob("magic_*/setup.py"), *(ROOT / "ros2_ws/src").glob("magic_*/setup.py")]:
        package = setup.parent.name
        programs = setup.parent / package / "programs.py"
        modules = dict(re.findall(r'^(\w+) = program\("([\w.]+)"\)', programs.read_text(), re.MULTILINE)) if programs.is_file() else {}
        for name, function in re.findall(r'"(\w+) = \w+\.programs:(\w+)"', setup.read_text().replace("{PACKAGE}", package)):
            found[package, name] = modules[function]
    return found


EXECUTABLES = executables()


def parsed(monkeypatch, module, words):
    """Put a command line through a module's own parser, and no further."""
    parse = argparse.ArgumentParser.parse_args

    def once(self, *given, **options):
        parse(self, *given, **options)
        raise ParsedError

    with monkeypatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", once)
        patch.setattr(sys, "argv", [module, *words])
        main = importlib.import_module(module).main
        with pytest.raises(ParsedError):
            main(words) if words else main()


def files_are_there(words):
    for word in words:
        inside = word.split(":=")[-1]
        if not inside.startswith("ros2_ws/.venv/") and re.match(
            r"^(bags|ros2_ws|docs|magic_(perception|matcher|planner|verifier)|tests)/", inside
        ):
            assert (ROOT / inside).exists(), inside


def declared():
    """Node -> its parameters, as the reference has them."""
    text = (ROOT / "docs/reference.md").read_text()
    return {n: set(re.findall(r"^\| `([\w.]+)` \|", text.split(f"### {n}\n")[1].split("\n#")[0], re.MULTILINE)) for n in NODES}


def run_is_right(monkeypatch, words):
    package, name, *rest = words
    assert (package, name) in EXECUTABLES, f"{package} has no {name}"
    if rest == ["--version"]:
        return
    node = next((n for n, program in NODES.items() if program == (package, name)), None)
    if node is None:
        parsed(monkeypatch, EXECUTABLES[package, name], rest)
        return
    assert not rest or rest[0] == "--ros-args"
    given = [v for k, v in itertools.pairwise(rest) if k == "-p"]
    assert len(rest) in (0, 1 + 2 * len(given))
    for rule in given:
        assert rule.split(":=")[0] in declared()[node], rule


def launch_is_right(words):
    package, file, *rest = words
    assert package == "magic_bringup"
    known = {a.get("name") for a in ElementTree.parse(ROOT / "ros2_ws/src/magic_bringup/launch" / file).getroot().findall("arg")}
    for rule in rest:
        name, equals, _ = rule.partition(":=")
        assert equals and name in known, rule


def goal_is_right(words):
    """Type and fields of a service call or an action goal."""
    text = next((w for w in words if w.startswith("{")), None)
    kind = next(w for w in words if w.count("/") == 2 and not w.startswith("/"))
    package, group, name = kind.split("/")
    interface = getattr(importlib.import_module(f"{package}.{group}"), name)
    message = interface.Goal if group == "action" else interface.Request
    if text is not None:
        assert set(yaml.safe_load(text)) <= set(message.get_fields_and_field_types())


@pytest.mark.parametrize("command", ALL)
def test_a_command_of_the_documents_works(command, readers, monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    if any(command.startswith(other) for other in OTHERS):
        files_are_there([w.removeprefix("./") for w in shlex.split(command)])
        return
    words = [readers(w) for w in shlex.split(command)]
    files_are_there(words)
    if command.startswith(QUICK):
        run_quick(command, words, tmp_path, monkeypatch)
        return
    first, *rest = words
    if first == "source":
        assert rest == ["ros2_ws/env.sh"]
    elif first == "bash":
        script_is_right(monkeypatch, rest)
    elif first in ("python", "python3"):
        module = rest[1] if rest[0] == "-m" else None
        assert (module and importlib.util.find_spec(module)) or (ROOT / rest[0]).is_file()
        if module:
            parsed(monkeypatch, module, rest[2:])
    elif first == "ros2" and rest[0] == "run":
        run_is_right(monkeypatch, rest[1:])
    elif first == "ros2" and rest[0] == "launch":
        launch_is_right(rest[1:])
    elif first == "ros2":
        if rest[:2] in (["service", "call"], ["action", "send_goal"]):
            goal_is_right(rest[2:])
        own = pytest.importorskip("magic_ros2cli.main")
        verb = own.VERBS[rest[0]][rest[1]]
        monkeypatch.setattr(own.environment, "prepare", lambda: None)
        parser = argparse.ArgumentParser.parse_args

        def once(self, *given, **options):
            parser(self, *given, **options)
            raise ParsedError

        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", once)
        with pytest.raises(ParsedError):
            getattr(importlib.import_module(f"magic_ros2cli.{verb}"), f"{rest[0]}_{rest[1]}")(rest[2:])
    else:
        raise AssertionError(f"nothing is known of {first}")


def script_is_right(monkeypatch, words):
    script, *rest = words
    name = Path(script).name
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
    if name == "demo.sh" and "--live" in rest:
        parsed(monkeypatch, "magic_lab.live", rest)
    elif name in ("demo.sh", "tables.sh"):
        parsed(monkeypatch, {"demo.sh": "magic_bringup.demo", "tables.sh": "magic_verifier.tables"}[name], rest)
    elif name == "setup.sh":
        assert set(rest) <= {"--rebuild", "--help"}
    else:
        assert name == "test.sh"


def run_quick(command, words, folder, monkeypatch):
    """As it stands, in a folder of its own; executables by their modules, as this checkout has them."""
    monkeypatch.chdir(folder)
    (folder / "strategies").mkdir(exist_ok=True)
    if words[0] == "bash":
        done = subprocess.run(["bash", str(ROOT / words[1]), *words[2:]], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0 and done.stdout
    else:
        rest = [w.replace("~", str(Path(ROOT / "ros2_ws/src/magic_bringup"))) for w in words[4:]]
        assert importlib.import_module(EXECUTABLES[words[2], words[3]]).main(rest) == 0, command


def test_words_that_look_like_a_placeholder_are_replaced(readers):
    assert (
        readers("BAG") != "BAG"
        and readers("params:=FILE").endswith("FILE.yaml")
        and readers("fg") == "fg"
        and readers("C.png").endswith("C.png")
    )


def test_links_between_documents_lead_somewhere():
    anchors = {}
    for path in DOCUMENTS:
        heads = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
        anchors[path] = {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in heads}
    for path in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#\s]*(?:#[\w-]+)?)\)", path.read_text()):
            if target.startswith("http"):
                continue
            name, _, anchor = target.partition("#")
            other = (path.parent / name).resolve() if name else path
            assert other.exists(), f"{path.name}: {target}"
            if anchor and other in anchors:
                assert anchor in anchors[other], f"{path.name}: {target}"


def test_the_parts_of_the_reference_that_need_no_node_are_up_to_date():
    page = (ROOT / "docs/reference.md").read_text()
    for part in reference.static_parts():
        assert part in page, "docs/reference.md is not up to date: ros2 run magic_bringup reference"


def test_programs_of_the_environment_that_documents_name_are_there():
    named = {name for path in DOCUMENTS for name in re.findall(r"ros2_ws/\.venv/bin/([\w-]+)", path.read_text())}
    assert named and not [name for name in named if not (Path(sys.prefix) / "bin" / name).exists()]


def test_every_symptoms_code_exists():
    from magic_core.errors import Code

    text = (ROOT / "docs/troubleshooting.md").read_text()
    for name in re.findall(r"`([A-Z]+(?:_[A-Z]+)+|BUSY)`", text):
        assert name in Code.__members__ or name.startswith("ROS_"), name


def test_every_figure_of_the_readme_stands_in_the_results():
    """Figures of measurements are in one place: the README has none in a table."""
    rows = [line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith("|")]
    assert not [row for row in rows if re.search(r"\d+ of \d+|\d\.\d+ (s|mm|%)", row)]
    results = (ROOT / "docs/results.md").read_text()
    assert all(part.count("`") for part in results.split("\n## ")[1:6])  # each names its command


def test_files_for_containers_name_what_is_there():
    import json

    folder = ROOT / ".devcontainer"
    build = json.loads((folder / "devcontainer.json").read_text())["build"]
    recipe = (folder / build["dockerfile"]).read_text()
    assert f"AS {build['target']}" in recipe and "bash ros2_ws/setup.sh" in recipe
    packages = set(re.findall(r"lib[\w.+-]+|g\+\+|cmake|make|python3-\w+", recipe))
    wanted = set(re.findall(r":(lib[\w.+-]+)", (ROOT / "ros2_ws/setup.sh").read_text()))
    assert wanted <= packages, wanted - packages
    assert sys.version_info >= (3, 10)


def test_every_verb_of_the_small_ros2_stands_in_the_readme():
    told = (ROOT / "README.md").read_text()
    for command, verbs in VERBS.items():
        assert f"`{command} {'|'.join(sorted(verbs))}`".replace(" `", "`") in told


def test_methods_that_the_documents_name_are_methods():
    for path in DOCUMENTS:
        named = set(re.findall(r"--method (\w+)", path.read_text()))
        assert named <= {*evaluated.METHODS, *perceived.METHODS}, path
