"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

verifier = program("magic_verifier.node")
evaluate = program("magic_verifier.evaluate")
learn = program("magic_verifier.learn")
reality = program("magic_verifier.reality")
benchmark = program("magic_verifier.benchmark")
maniskill = program("magic_verifier.maniskill")
