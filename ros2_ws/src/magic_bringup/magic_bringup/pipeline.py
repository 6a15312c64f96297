"""The candidates of a run, by its former name: scripts outside this repository import it from here."""

from magic_server.pipeline import *  # noqa: F403
