"""Command lines that are partly ROS's."""

from __future__ import annotations

from collections.abc import Sequence


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """A program's own arguments, and those between ``--ros-args`` and ``--`` (or the end), with these words, for ``rclpy.init``.

    Not ``rclpy.utilities.remove_ros_args``: that one also takes out every word of the form ``A:=B``, which ROS 1 read as a remapping,
    and ``rclpy.init`` would heed it as one.
    """
    own: list[str] = []
    ros: list[str] = []
    in_ros = False
    for word in arguments:
        if not in_ros and word == "--ros-args":
            in_ros = True
        (ros if in_ros else own).append(word)
        if in_ros and word == "--":
            in_ros = False
    return own, ros
