"""The package's executables, which import the rest of it only when they have begun."""

from magic_core.entry import program

strategy_server = program("magic_server.strategy_server")
