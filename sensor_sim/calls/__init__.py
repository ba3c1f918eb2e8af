"""The Python calls behind the commands, a module for each call."""
