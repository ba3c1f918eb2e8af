"""The Python calls behind the commands, a module a call."""
