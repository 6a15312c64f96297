"""Reading a bag's messages, by its former name: scripts outside this repository import it from here."""

from magic_bags.bag_messages import *  # noqa: F403
