"""XML launch files: which processes a file asks for. Starts nothing and imports nothing of ROS.

What is read (ROS 2's XML format, as far as this project uses it): ``launch``, ``arg`` (name, default, value, description, ``choice``),
``let``, ``include`` (file, ``arg``), ``group`` (scoped), ``push_ros_namespace``, ``set_env``, ``set_remap``, ``node`` (pkg, exec, name,
namespace, args, ros_args, output, respawn, respawn_delay, launch-prefix, on_exit; ``param`` (also from files, with allow_substs),
``remap``, ``env``), ``executable`` (cmd, cwd, name, output, ...; ``env``), ``log`` (message); ``if`` and ``unless`` on each; the
substitutions ``var``, ``env``, ``find-pkg-share``, ``find-pkg-prefix``, ``dirname``, ``eval``, ``equals``, ``not-equals``, ``not``,
``and``, ``or``. Anything else is refused by name.
"""

from __future__ import annotations

import math
import os
import shlex
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from magic_ros2cli import packages
from magic_ros2cli.errors import CommandError

#: Attributes that every process may have besides its own.
PROCESS_ATTRIBUTES = {"name", "args", "output", "respawn", "respawn_delay", "launch-prefix", "on_exit", "cwd", "if", "unless"}
OUTPUTS = ("log", "screen", "both", "own_log")


@dataclass(frozen=True)
class Argument:
    """A declared launch argument; ``default`` None: it has to be given."""

    name: str
    default: str | None = None
    description: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Parameters:
    """Parameters of a node: a YAML file, the text of one (with substitutions done), or one named value."""

    file: str = ""
    text: str = ""
    name: str = ""
    value: Any = None


@dataclass(frozen=True)
class Process:
    """One process to start. ``label`` is what its output is prefixed with, without the number that launch adds."""

    label: str
    command: tuple[str, ...]
    environment: tuple[tuple[str, str], ...] = ()
    output: str = "log"
    respawn: bool = False
    respawn_delay: float = 0.0
    ends_launch: bool = False
    directory: str = ""
    is_node: bool = False
    ros_arguments: tuple[str, ...] = ()
    parameters: tuple[Parameters, ...] = ()


@dataclass
class LaunchFile:
    """What a launch file amounts to for given arguments."""

    arguments: list[Argument] = field(default_factory=list)
    processes: list[Process] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)


def _lower(value: bool) -> str:
    """A truth as launch files write it."""
    return str(value).lower()


@dataclass
class _Scope:
    configurations: dict[str, str]
    environment: dict[str, str]
    namespace: str = ""
    remaps: tuple[tuple[str, str], ...] = ()


def find(package: str, name: str) -> Path:
    """A launch file below a package's share folder, as ``ros2 launch`` looks for it."""
    share = packages.share_of(package)
    found = sorted(p for p in share.rglob(name) if p.is_file())
    if not found:
        raise CommandError(f"file '{name}' was not found in the share directory of package '{package}' which is at '{share}'")
    if len(found) > 1:
        raise CommandError(
            f"file '{name}' was found more than once in the share directory of package '{package}': {', '.join(map(str, found))}"
        )
    return found[0]


def parse(path: Path | str, given: dict[str, str], declared_only: bool = False) -> LaunchFile:
    """Evaluate a launch file. ``declared_only``: collect the arguments and forgive what is missing (for ``--show-args``).

    Raises :class:`CommandError` with the file and what was wrong.
    """
    result = LaunchFile()
    reader = _Reader(result, declared_only)
    reader.file(Path(path), _Scope(dict(given), {}))
    return result


class _Reader:
    def __init__(self, result: LaunchFile, declared_only: bool) -> None:
        self.result = result
        self.declared_only = declared_only
        self.stack: list[Path] = []

    # ------------------------------------------------------------------------------------------ structure
    def file(self, path: Path, scope: _Scope) -> None:
        path = path.absolute()
        if path in self.stack:
            raise CommandError(f"launch file {path} includes itself")
        try:
            root = ElementTree.parse(path).getroot()
        except OSError as error:
            raise CommandError(f"cannot read launch file {path}: {error.strerror}") from None
        except ElementTree.ParseError as error:
            raise CommandError(f"launch file {path} is no XML launch file: {error}") from None
        if root.tag != "launch":
            raise CommandError(f"launch file {path}: the root is <{root.tag}>, not <launch>")
        self.stack.append(path)
        try:
            for entity in root:
                self.entity(entity, scope)
        finally:
            self.stack.pop()

    def entity(self, entity: ElementTree.Element, scope: _Scope) -> None:
        handler = getattr(self, "tag_" + entity.tag.replace("-", "_"), None)
        if handler is None:
            known = sorted(name[4:] for name in dir(self) if name.startswith("tag_"))
            raise self.wrong(f"unknown tag <{entity.tag}> (allowed: {', '.join(known)})")
        if self.wanted(entity, scope):
            handler(entity, scope)

    def wanted(self, entity: ElementTree.Element, scope: _Scope) -> bool:
        """The ``if`` and ``unless`` conditions."""
        if self.declared_only and entity.tag in ("include", "group", "arg"):
            return True
        if "if" in entity.attrib and "unless" in entity.attrib:
            raise self.wrong(f"<{entity.tag}> has both if and unless")
        if "if" in entity.attrib:
            return self.truth(self.attribute(entity, "if", scope), "if")
        if "unless" in entity.attrib:
            return not self.truth(self.attribute(entity, "unless", scope), "unless")
        return True

    def tag_arg(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"name", "default", "description", "if", "unless"})
        name = self.attribute(entity, "name", scope)
        default = self.attribute(entity, "default", scope) if "default" in entity.attrib else None
        choices = []
        for child in entity:
            if child.tag != "choice" or "value" not in child.attrib:
                raise self.wrong(f"<arg> may hold <choice value=.../> only, not <{child.tag}>")
            choices.append(self.attribute(child, "value", scope))
        argument = Argument(name, default, self.attribute(entity, "description", scope, ""), tuple(choices))
        if argument.name not in {a.name for a in self.result.arguments}:
            self.result.arguments.append(argument)
        if name not in scope.configurations:
            if default is None:
                if self.declared_only:
                    return
                about = f" (description: '{argument.description}')" if argument.description else ""
                raise CommandError(
                    f"Included launch description missing required argument '{name}'{about}, given: [{', '.join(scope.configurations)}]"
                )
            scope.configurations[name] = default
        value = scope.configurations[name]
        if choices and value not in choices:
            raise CommandError(f'Argument "{name}" provided value "{value}" is not valid. Valid options are: {choices}')

    def tag_let(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"name", "value", "if", "unless"})
        scope.configurations[self.attribute(entity, "name", scope)] = self.attribute(entity, "value", scope)

    def tag_set_env(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"name", "value", "if", "unless"})
        scope.environment[self.attribute(entity, "name", scope)] = self.attribute(entity, "value", scope)

    def tag_set_remap(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"from", "to", "if", "unless"})
        scope.remaps += ((self.attribute(entity, "from", scope), self.attribute(entity, "to", scope)),)

    def tag_push_ros_namespace(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"namespace", "if", "unless"})
        scope.namespace = _join(scope.namespace, self.attribute(entity, "namespace", scope))

    def tag_group(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"scoped", "forwarding", "if", "unless"})
        inner = scope
        if self.truth(self.attribute(entity, "scoped", scope, "true"), "scoped"):
            inner = replace(scope, configurations=dict(scope.configurations), environment=dict(scope.environment))
        for child in entity:
            self.entity(child, inner)

    def tag_include(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"file", "if", "unless"})
        for child in entity:
            if child.tag not in ("arg", "let"):
                raise self.wrong(f"<include> may hold <arg name=... value=.../> only, not <{child.tag}>")
        try:
            path = Path(self.attribute(entity, "file", scope))
            for child in entity:
                if self.wanted(child, scope):
                    scope.configurations[self.attribute(child, "name", scope)] = self.attribute(child, "value", scope)
        except CommandError:
            if self.declared_only:
                return
            raise
        if path.suffix != ".xml":
            raise self.wrong(f"cannot include {path} (allowed: XML launch files, *.xml)")
        self.file(path, scope)

    def tag_log(self, entity: ElementTree.Element, scope: _Scope) -> None:
        self.allow(entity, {"message", "level", "if", "unless"})
        if not self.declared_only:
            self.result.messages.append(self.attribute(entity, "message", scope))

    def tag_executable(self, entity: ElementTree.Element, scope: _Scope) -> None:
        if self.declared_only:
            return
        self.allow(entity, PROCESS_ATTRIBUTES | {"cmd", "shell"})
        command = shlex.split(self.attribute(entity, "cmd", scope)) + shlex.split(self.attribute(entity, "args", scope, ""))
        if not command:
            raise self.wrong("<executable> has an empty cmd")
        environment = dict(scope.environment)
        for child in entity:
            if child.tag != "env":
                raise self.wrong(f"<executable> may hold <env name=... value=.../> only, not <{child.tag}>")
            if self.wanted(child, scope):
                environment[self.attribute(child, "name", scope)] = self.attribute(child, "value", scope)
        label = self.attribute(entity, "name", scope, Path(command[0]).name)
        self.result.processes.append(self.process(entity, scope, label, command, environment))

    def tag_node(self, entity: ElementTree.Element, scope: _Scope) -> None:
        if self.declared_only:
            return
        self.allow(entity, PROCESS_ATTRIBUTES | {"pkg", "exec", "namespace", "ros_args", "exec_name"})
        executable = self.attribute(entity, "exec", scope)
        command = [str(packages.executable(self.attribute(entity, "pkg", scope), executable))]
        command += shlex.split(self.attribute(entity, "args", scope, ""))
        environment = dict(scope.environment)
        parameters: list[Parameters] = []
        remaps = list(scope.remaps)
        for child in entity:
            if not self.wanted(child, scope):
                continue
            if child.tag == "param":
                parameters += self.parameters(child, scope)
            elif child.tag == "remap":
                remaps.append((self.attribute(child, "from", scope), self.attribute(child, "to", scope)))
            elif child.tag == "env":
                environment[self.attribute(child, "name", scope)] = self.attribute(child, "value", scope)
            else:
                raise self.wrong(f"<node> may hold <param>, <remap> and <env> only, not <{child.tag}>")
        ros = shlex.split(self.attribute(entity, "ros_args", scope, ""))
        if name := self.attribute(entity, "name", scope, ""):
            ros += ["-r", f"__node:={name}"]
        if namespace := _join(scope.namespace, self.attribute(entity, "namespace", scope, "")):
            ros += ["-r", f"__ns:={namespace}"]
        for old, new in remaps:
            ros += ["-r", f"{old}:={new}"]
        label = self.attribute(entity, "exec_name", scope, executable)
        process = self.process(entity, scope, label, command, environment)
        self.result.processes.append(replace(process, is_node=True, ros_arguments=tuple(ros), parameters=tuple(parameters)))

    def parameters(self, entity: ElementTree.Element, scope: _Scope, prefix: str = "") -> list[Parameters]:
        self.allow(entity, {"name", "value", "from", "allow_substs", "type", "if", "unless"})
        if "from" in entity.attrib:
            path = self.attribute(entity, "from", scope)
            if not Path(path).is_file():
                raise self.wrong(f"the parameter file {path} does not exist")
            if self.truth(self.attribute(entity, "allow_substs", scope, "false"), "allow_substs"):
                return [Parameters(text=self.substituted(path, scope))]
            return [Parameters(file=path)]
        name = prefix + self.attribute(entity, "name", scope)
        if "value" not in entity.attrib:
            nested = [p for child in entity for p in self.parameters(child, scope, f"{name}.")]
            if not nested:
                raise self.wrong(f"<param name={name!r}> has no value")
            return nested
        return [
            Parameters(
                name=name, value=self.typed(name, self.attribute(entity, "value", scope), self.attribute(entity, "type", scope, "auto"))
            )
        ]

    def substituted(self, path: str, scope: _Scope) -> str:
        """The text of a parameter file with its substitutions done; comments are left out first, as launch_ros does."""
        import yaml

        try:
            text = self.substitute(yaml.safe_dump(yaml.safe_load(Path(path).read_text())), scope)
            yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise self.wrong(f"the parameter file {path} is no YAML: {error}") from None
        return text

    def typed(self, name: str, text: str, kind: str) -> Any:
        import yaml

        if kind == "str":
            return text
        if kind not in ("auto", "bool", "int", "float", "yaml"):
            raise self.wrong(f"type of param {name!r} is {kind!r} (allowed: auto, bool, int, float, str, yaml)")
        try:
            value = yaml.safe_load(text) if text.strip() else text
            if kind in ("int", "float"):
                value = {"int": int, "float": float}[kind](value)
        except (yaml.YAMLError, TypeError, ValueError):
            raise self.wrong(f"param {name!r} of type {kind} is {text!r}") from None
        if kind == "bool" and not isinstance(value, bool):
            raise self.wrong(f"param {name!r} of type bool is {text!r} (allowed: true, false)")
        return value

    def process(self, entity: ElementTree.Element, scope: _Scope, label: str, command: list[str], environment: dict[str, str]) -> Process:
        output = self.attribute(entity, "output", scope, "log")
        if output not in OUTPUTS:
            raise self.wrong(f"output of {label} is {output!r} (allowed: {', '.join(OUTPUTS)})")
        on_exit = self.attribute(entity, "on_exit", scope, "")
        if on_exit not in ("", "shutdown"):
            raise self.wrong(f"on_exit of {label} is {on_exit!r} (allowed: shutdown)")
        delay = self.attribute(entity, "respawn_delay", scope, "0")
        try:
            seconds = float(delay)
        except ValueError:
            seconds = math.nan
        if not seconds >= 0:
            raise self.wrong(f"respawn_delay of {label} is {delay!r} (allowed: seconds, 0 or more)")
        return Process(
            label=label,
            command=tuple(shlex.split(self.attribute(entity, "launch-prefix", scope, "")) + command),
            environment=tuple(environment.items()),
            output=output,
            respawn=self.truth(self.attribute(entity, "respawn", scope, "false"), "respawn"),
            respawn_delay=seconds,
            ends_launch=on_exit == "shutdown",
            directory=self.attribute(entity, "cwd", scope, ""),
        )

    # ------------------------------------------------------------------------------------------ attributes
    def attribute(self, entity: ElementTree.Element, name: str, scope: _Scope, default: str | None = None) -> str:
        if name not in entity.attrib:
            if default is None:
                raise self.wrong(f"<{entity.tag}> needs the attribute '{name}'")
            return default
        return self.substitute(entity.attrib[name], scope)

    def allow(self, entity: ElementTree.Element, names: set[str]) -> None:
        for name in entity.attrib:
            if name not in names:
                raise self.wrong(f"<{entity.tag}> has no attribute '{name}' (allowed: {', '.join(sorted(names))})")

    def truth(self, text: str, what: str) -> bool:
        lower = text.strip().lower()
        if lower in ("true", "1"):
            return True
        if lower in ("false", "0"):
            return False
        raise self.wrong(f"{what} is {text!r} (allowed: true, false, 1, 0)")

    def wrong(self, message: str) -> CommandError:
        return CommandError(f"launch file {self.stack[-1] if self.stack else ''}: {message}")

    # ------------------------------------------------------------------------------------------ substitutions
    def substitute(self, text: str, scope: _Scope) -> str:
        """Replace every ``$(name arguments...)``, innermost first."""
        result, position = "", 0
        while (start := text.find("$(", position)) >= 0:
            end = self.closing(text, start + 2)
            result += text[position:start] + self.evaluate(text[start + 2 : end], scope)
            position = end + 1
        return result + text[position:]

    def closing(self, text: str, position: int) -> int:
        depth, quote = 1, ""
        while position < len(text):
            character = text[position]
            if character == "\\":
                position += 1
            elif quote:
                quote = "" if character == quote else quote
            elif character in "'\"":
                quote = character
            elif character == "(":
                depth += 1
            elif character == ")":
                depth -= 1
                if depth == 0:
                    return position
            position += 1
        raise self.wrong(f"'{text}' has a $( that is not closed")

    def evaluate(self, text: str, scope: _Scope) -> str:
        """What one substitution, without its ``$(`` and ``)``, stands for."""
        name, _, rest = text.strip().partition(" ")
        arguments = self.split(rest, scope)
        # How many arguments a substitution takes, at least and at most, and what it makes of them.
        known: dict[str, tuple[int, float, Callable[..., str]]] = {
            "var": (1, 2, lambda *a: self.configuration(scope, *a)),
            "env": (1, 2, lambda *a: self.variable(scope, *a)),
            "find-pkg-share": (1, 1, lambda a: str(packages.share_of(a))),
            "find-pkg-prefix": (1, 1, lambda a: str(packages.prefix_of(a))),
            "dirname": (0, 0, lambda: str(self.stack[-1].parent)),
            "eval": (0, math.inf, lambda *a: self.computed(" ".join(a))),
            "equals": (2, 2, lambda a, b: _lower(a == b)),
            "not-equals": (2, 2, lambda a, b: _lower(a != b)),
            "not": (1, 1, lambda a: _lower(not self.truth(a, "not"))),
            "and": (2, 2, lambda a, b: _lower(all([self.truth(a, "and"), self.truth(b, "and")]))),
            "or": (2, 2, lambda a, b: _lower(any([self.truth(a, "or"), self.truth(b, "or")]))),
        }
        if name not in known:
            raise self.wrong(f"unknown substitution $({name}) (allowed: {', '.join(known)})")
        low, high, value = known[name]
        if not low <= len(arguments) <= high:
            raise self.wrong(f"$({text}) has {len(arguments)} arguments (allowed: {low}{'' if low == high else f' to {high}'})")
        return value(*arguments)

    def configuration(self, scope: _Scope, name: str, default: str | None = None) -> str:
        """The value of a launch argument."""
        if name in scope.configurations:
            return scope.configurations[name]
        if default is not None:
            return default
        if self.declared_only:
            return f"$(var {name})"
        raise self.wrong(f"launch configuration '{name}' does not exist (there are: {', '.join(sorted(scope.configurations)) or 'none'})")

    def variable(self, scope: _Scope, name: str, default: str | None = None) -> str:
        """The value of an environment variable, as the launch file or the shell set it."""
        value = scope.environment.get(name, os.environ.get(name, default))
        if value is None:
            raise self.wrong(f"environment variable '{name}' does not exist")
        return value

    def computed(self, expression: str) -> str:
        """A Python expression's value; like launch's own, it is as trusted as the launch file itself."""
        allowed = {f.__name__: f for f in (str, int, float, bool, len, min, max)}
        try:
            return str(eval(expression, {"__builtins__": {}, "math": math, **allowed}))
        except Exception as error:
            raise self.wrong(f"$(eval {expression}): {type(error).__name__}: {error}") from None

    def split(self, text: str, scope: _Scope) -> list[str]:
        """Arguments of a substitution: separated by blanks, quoted where they hold some, with substitutions inside."""
        arguments: list[str] = []
        current, started, quote, position = "", False, "", 0
        while position < len(text):
            character = text[position]
            if text.startswith("$(", position):
                end = self.closing(text, position + 2)
                current += self.evaluate(text[position + 2 : end], scope)
                started, position = True, end
            elif character == "\\" and position + 1 < len(text):
                position += 1
                current, started = current + text[position], True
            elif quote:
                if character == quote:
                    quote = ""
                else:
                    current += character
            elif character in "'\"":
                quote, started = character, True
            elif character.isspace():
                if started:
                    arguments.append(current)
                current, started = "", False
            else:
                current, started = current + character, True
            position += 1
        return [*arguments, current] if started else arguments


def _join(outer: str, inner: str) -> str:
    """A namespace inside another; an absolute one stays as it is."""
    if inner.startswith("/"):
        return inner
    joined = "/".join(part.strip("/") for part in (outer, inner) if part.strip("/"))
    return f"/{joined}" if joined else ""
