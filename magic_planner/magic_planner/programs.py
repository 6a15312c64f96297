"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

planner = program("magic_planner.node")
describe_robot = program("magic_planner.describe_robot")
