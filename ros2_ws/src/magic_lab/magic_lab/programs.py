"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

lab = program("magic_lab.node")
trials = program("magic_lab.trials")
