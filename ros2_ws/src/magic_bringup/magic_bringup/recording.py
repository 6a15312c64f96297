"""Recording a made scene, by its former name: scripts outside this repository import it from here."""

from magic_bags.recording import *  # noqa: F403
