"""Reading a bag's messages: :mod:`magic_bags.bag_messages`, by the name that scripts of users import."""

from magic_bags.bag_messages import messages

__all__ = ["messages"]
