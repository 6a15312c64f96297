"""The one exception that ends a command with a line on stderr."""


class CommandError(Exception):
    """What the user is told; the command ends with ``status``."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status
