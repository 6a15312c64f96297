"""A small ``ros2`` command for environments that have rclpy but no ros2cli.

It has the verbs that the project's README uses, with ros2cli's syntax, options and output shape, and nothing else.
"""
