"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

perception = program("magic_perception.node")
perceive_images = program("magic_perception.perceive_images")
evaluate = program("magic_perception.evaluate")
learn_seams = program("magic_perception.learn_seams")
learn_confidence = program("magic_perception.learn_confidence")
learn_surface_error = program("magic_perception.learn_surface_error")
