"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

bag_player = program("magic_bags.bag_player")
bag_recorder = program("magic_bags.bag_recorder")
