"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

matcher = program("magic_matcher.node")
match_images = program("magic_matcher.match_images")
match_meshes = program("magic_matcher.match_meshes")
bench = program("magic_matcher.bench")
