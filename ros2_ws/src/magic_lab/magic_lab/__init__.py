"""A laboratory in simulation behind the topics and actions of a real one."""
