"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

planner = program("magic_planner.node")
