"""The sets of tools and targets that a strategy is evaluated on, as data in its folder::

    environment:
      evaluation:
        targets: [cylinder:0.015, cylinder:0.02]     # names of targets; by default the demonstration's own
        choose: true                                 # with a floating gripper, all tools of a set are offered for each target
        values: {noise: 1.0}                         # numbers of the goal in an evaluation
        values_of: {watch: {distance: 0.1}}          # for tools whose name has that in it
        sets:
          own: {tools: [scissors:1, hanger:1]}
          unseen: {each: ["caliper:{}", "hanger:{}"], first: 50000, count: 60, paired: true}
        near_misses: [letter:60001,glyph=I]          # the first of the set `controls`

Of ``each`` the entries come in turn, with numbers from ``first`` up; another seed of the evaluation begins ``a_seed`` (``count``) further.
A ``paired`` set gives each tool one of the targets, in turn, others all of them.  How tools and targets are named:
:mod:`magic_verifier.cases`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from magic_core.errors import Code, MagicError
from magic_core.strategy import Strategy


@dataclass(frozen=True)
class ToolSet:
    """Tools by name, or made in turn; see the module."""

    tools: tuple[str, ...] = ()
    each: tuple[str, ...] = ()
    first: int = 0
    count: int = 0
    a_seed: int = -1
    paired: bool = False

    def names(self, seed: int) -> list[str]:
        """The tools for a seed of the evaluation."""
        first = self.first + (self.count if self.a_seed < 0 else self.a_seed) * seed
        return [*self.tools, *(self.each[k % len(self.each)].format(first + k) for k in range(self.count))]


@dataclass(frozen=True)
class Evaluation:
    """What a strategy is evaluated on."""

    targets: tuple[str, ...] = ("demonstration",)
    choose: bool = False
    values: Mapping[str, float] = field(default_factory=dict)
    values_of: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sets: Mapping[str, ToolSet] = field(default_factory=dict)
    near_misses: tuple[str, ...] = ()

    def numbers(self, tool: str) -> dict[str, float]:
        """The goal's numbers for a tool."""
        found = dict(self.values)
        for part, values in self.values_of.items():
            if part in tool:
                found |= values
        return found


def evaluation_of(strategy: Strategy) -> Evaluation:
    """What stands in a strategy's folder; raises ``BAD_STRATEGY`` with the key, the value and what is allowed."""
    data = strategy.environment.get("evaluation") or {}
    where = "environment.evaluation"
    _check(data, where, {"targets": list, "choose": bool, "values": dict, "values_of": dict, "sets": dict, "near_misses": list})
    sets = {}
    for name, entry in data.get("sets", {}).items():
        path = f"{where}.sets.{name}"
        _check(entry, path, {"tools": list, "each": list, "first": int, "count": int, "a_seed": int, "paired": bool})
        given: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
        tools = ToolSet(**given)
        if not tools.tools and not (tools.each and tools.count > 0):
            raise MagicError(Code.BAD_STRATEGY, path, entry, "tools, or each with a count above 0")
        for each in tools.each:
            try:
                each.format(0)
            except (IndexError, KeyError, ValueError) as error:
                raise MagicError(Code.BAD_STRATEGY, f"{path}.each", each, "a name with {} where its number goes") from error
        sets[str(name)] = tools
    more = {key: tuple(data[key]) for key in ("targets", "near_misses") if data.get(key)}
    found = Evaluation(
        choose=data.get("choose", False), values=data.get("values", {}), sets=sets, values_of=data.get("values_of", {}), **more
    )
    for values in (found.values, *found.values_of.values()):
        strategy.goal.with_values(dict(values)).resolved()
    return found


def _check(data: Any, path: str, keys: dict[str, type]) -> None:
    if not isinstance(data, dict):
        raise MagicError(Code.BAD_STRATEGY, path, data, f"a mapping with {', '.join(keys)}")
    for key, value in data.items():
        if key not in keys:
            raise MagicError(Code.BAD_STRATEGY, f"{path}: key", str(key), tuple(keys))
        if (
            not isinstance(value, keys[key])
            or (keys[key] is int and isinstance(value, bool))
            or (isinstance(value, list) and not all(isinstance(item, str) for item in value))
        ):
            kind = {list: "a list of names", bool: "true or false", dict: "a mapping", int: "a whole number"}[keys[key]]
            raise MagicError(Code.BAD_STRATEGY, f"{path}.{key}", value, kind)
