"""The reference of every parameter, code and interface, from the code itself: ``ros2 run magic_bringup reference [--check]``.

Parameters and endpoints are asked of the five nodes as they run with their defaults; launch arguments, codes and interfaces are read from
their files.  ``docs/reference.md`` is this command's output; a test compares the two.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from magic_bringup.graph import NODES
from magic_core.errors import Code, MagicError
from magic_core.remedies import REMEDIES

#: What is waited for a node to answer, s; for all of them to be up, s.
ASK, START = 10.0, 120.0
#: What every node of ROS has.
EVERYWHERE = ("/rosout", "/parameter_events", "/clock")
#: Names of parameter types, by rcl_interfaces/msg/ParameterType.
TYPES = ("", "bool", "int", "float", "string", "bytes", "bools", "ints", "floats", "strings")
BLOCKS = ((100, "Perception"), (200, "Matching"), (300, "Planning"), (400, "Verifying"), (500, "Execution"))


class Row(NamedTuple):
    """One parameter: its name, type, default, what is allowed, what it means."""

    name: str
    kind: str
    default: str
    allowed: str
    meaning: str


# ------------------------------------------------------------ asking the nodes


def _wait(future: Any, what: str) -> Any:
    """The answer of a service; raises SERVER_TIMEOUT."""
    came = threading.Event()
    future.add_done_callback(lambda _: came.set())
    if not came.wait(ASK):
        raise MagicError(Code.SERVER_TIMEOUT, what, f"no answer within {ASK:g} s")
    return future.result()


def ask_parameters(node: Any, name: str) -> list[Row]:
    """The parameters of a node that runs beside ``node``, which is being spun by somebody else."""
    from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
    from rclpy.parameter import parameter_value_to_python

    answers: list[Any] = []
    names: list[str] = []
    for kind, verb in ((ListParameters, "list"), (DescribeParameters, "describe"), (GetParameters, "get")):
        client = node.create_client(kind, f"{name}/{verb}_parameters")
        try:
            if not client.wait_for_service(ASK):
                raise MagicError(Code.SERVER_UNAVAILABLE, f"the parameters of {name} cannot be asked for")
            request = kind.Request() if verb == "list" else kind.Request(names=names)
            answers.append(_wait(client.call_async(request), f"{verb}_parameters of {name}"))
        finally:
            node.destroy_client(client)
        if verb == "list":
            # What ROS itself adds is in ROS's own documents.
            names = sorted(
                n for n in answers[0].result.names if n not in ("start_type_description_service",) and not n.startswith("qos_overrides")
            )
    descriptors, values = answers[1].descriptors, answers[2].values
    return [
        Row(d.name, TYPES[d.type], _shown(parameter_value_to_python(v)), _allowed(d), " ".join(d.description.split()))
        for d, v in zip(descriptors, values, strict=True)
    ]


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return value or '""'
    if value is None:
        return "none"
    return "[" + ", ".join(_shown(v) for v in value) + "]"


def _allowed(descriptor: Any) -> str:
    for span in (*descriptor.floating_point_range, *descriptor.integer_range):
        return f"{span.from_value:g} to {span.to_value:g}"
    return str(descriptor.additional_constraints).removeprefix("one of: ")


def ask_endpoints(node: Any, name: str) -> dict[str, list[tuple[str, str]]]:
    """What a node publishes, subscribes to and serves, actions told as such: kind -> (name, type)."""
    found: dict[str, list[tuple[str, str]]] = {"publishes": [], "subscribes to": [], "serves": []}
    asked: dict[str, Callable[[str, str], Any]] = {
        "publishes": node.get_publisher_names_and_types_by_node,
        "subscribes to": node.get_subscriber_names_and_types_by_node,
        "serves": node.get_service_names_and_types_by_node,
    }
    for what, ask in asked.items():
        for topic, types in ask(name, "/"):
            if topic in EVERYWHERE or ("/_action/" in topic and not topic.endswith("_action/send_goal")):
                continue
            if what == "serves" and topic.startswith(f"/{name}/"):
                continue  # the services of every node's parameters
            kind = types[0].replace("/msg/", "/").replace("/srv/", "/")
            if "/action/" in kind:
                kind = kind.replace("/action/", "/").removesuffix("_SendGoal") + " (action)"
            found[what].append(
                (topic.removesuffix("/_action/send_goal").lstrip("/") if "/tf" not in topic and topic != "/diagnostics" else topic, kind)
            )
    return {what: sorted(rows) for what, rows in found.items()}


def gather() -> tuple[dict[str, list[Row]], dict[str, dict[str, list[tuple[str, str]]]]]:
    """Parameters and endpoints of the five nodes, started for it in a domain of their own."""
    import os

    from magic_bringup.graph import Graph
    from magic_core.domain import isolated

    env = isolated()
    os.environ.update({k: env[k] for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")})
    with tempfile.TemporaryDirectory() as scratch, Graph(Path(scratch), env) as graph:
        graph.start_nodes()
        from magic_bringup.demo import Watcher

        watcher = Watcher((), lambda _line: None)
        try:
            deadline = time.monotonic() + START
            while watcher.ready():
                graph.check()
                if time.monotonic() > deadline:
                    raise MagicError(Code.SERVER_UNAVAILABLE, f"not up after {START:g} s: {', '.join(watcher.ready())}")
                threading.Event().wait(0.2)
            node = watcher.node
            return {n: ask_parameters(node, n) for n in NODES}, {n: ask_endpoints(node, n) for n in NODES}
        finally:
            watcher.close()


# ------------------------------------------------------------ the page


def _table(head: tuple[str, ...], rows: Any) -> str:
    """A table of Markdown; a bar within a cell is escaped."""
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return "\n".join([*lines, *(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows)]) + "\n"


def parameters_page(parameters: dict[str, list[Row]]) -> str:
    """The sections of the nodes' parameters."""
    parts = []
    for name, rows in parameters.items():
        package, program = NODES[name]
        cells = [(f"`{r.name}`", r.kind, f"`{r.default}`", r.allowed, r.meaning) for r in rows]
        parts.append(
            f"### {name}\n\n`ros2 run {package} {program}`\n\n" + _table(("parameter", "type", "default", "allowed", "meaning"), cells)
        )
    return "\n".join(parts)


def endpoints_page(endpoints: dict[str, dict[str, list[tuple[str, str]]]]) -> str:
    """What each node publishes, subscribes to and serves."""
    rows = [
        (name, what, f"`{topic}`", f"`{kind}`")
        for name, found in endpoints.items()
        for what, these in found.items()
        for topic, kind in these
    ]
    return _table(("node", "", "name", "type"), rows)


def _folder(package: str) -> Path:
    """Where a package's files are: beside this source, which may be newer than what is installed, else installed."""
    from ament_index_python.packages import get_package_share_directory

    source = Path(__file__).resolve().parents[2] / package
    return source if (source / "package.xml").is_file() else Path(get_package_share_directory(package))


def launch_page() -> str:
    """The arguments of the launch files."""
    parts = []
    for path in sorted((_folder("magic_bringup") / "launch").glob("*.launch.xml")):
        rows = []
        for argument in ET.parse(path).getroot().findall("arg"):
            choices = ", ".join(c.get("value") or '""' for c in argument.findall("choice"))
            default = argument.get("default")
            rows.append(
                (
                    f"`{argument.get('name')}`",
                    "required" if default is None else f"`{default}`" if default else '""',
                    choices,
                    argument.get("description", ""),
                )
            )
        parts.append(
            f"### {path.name}\n\n`ros2 launch magic_bringup {path.name}`\n\n" + _table(("argument", "default", "allowed", "meaning"), rows)
        )
    return "\n".join(parts)


def codes_page() -> str:
    """Every code, what it means and what to do."""
    parts = []
    for low, title in BLOCKS:
        rows = [(str(int(c)), f"`{c.name}`", REMEDIES[c].meaning, REMEDIES[c].mend) for c in Code if low <= int(c) < low + 100]
        parts.append(f"### {title}\n\n" + _table(("code", "name", "what has happened", "what to do"), rows))
    return "\n".join(parts)


def interfaces_page() -> str:
    """The text of every message, service and action."""
    share = _folder("magic_interfaces")
    parts = []
    for kind in ("action", "srv", "msg"):
        for path in sorted((share / kind).glob(f"*.{kind}")):
            if path.stem != "ResultCode":  # its numbers are the table of codes
                parts.append(f"### magic_interfaces/{kind}/{path.stem}\n\n```\n{path.read_text().strip()}\n```\n")
    return "\n".join(parts)


def render(parameters: dict[str, list[Row]], endpoints: dict[str, dict[str, list[tuple[str, str]]]]) -> str:
    """The whole page."""
    return f"""# Reference

Made from the code by `ros2 run magic_bringup reference`; a test holds it up to date. Do not edit it by hand.

## Parameters

As the nodes declare them. All but ROS's own are read at the start. `ros2 param describe NODE NAME` says the same of a running node.

{parameters_page(parameters)}
## Topics, services and actions

Relative names, under the namespace of the node; `/diagnostics`, `/tf` and `/tf_static` are absolute. Cameras have their own names in `perception`'s parameter `cameras`.

{endpoints_page(endpoints)}
## Launch files

{launch_page()}
## Codes

0 is `OK`. Every answer carries a code and a sentence with the value that was wrong and what is allowed.

{codes_page()}
## Interfaces

{interfaces_page()}"""


def static_parts() -> list[str]:
    """What of the page needs no running node: a quick test compares it."""
    return [launch_page(), codes_page(), interfaces_page()]


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status: 0, or 1 where --check finds a difference."""
    parser = argparse.ArgumentParser(prog="reference", description="Write docs/reference.md from the code.")
    parser.add_argument("--out", type=Path, default=Path("docs/reference.md"), help="file (default docs/reference.md)")
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    given = parser.parse_args(arguments)
    try:
        page = render(*gather())
        if given.check:
            same = given.out.read_text() == page
            print(f"{given.out} is {'up to date' if same else 'not up to date: run this without --check'}")
            return 0 if same else 1
        given.out.write_text(page)
    except (MagicError, OSError) as error:
        print(f"reference: {error}", file=sys.stderr)
        return 1
    print(given.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
