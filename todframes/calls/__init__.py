"""The Python calls behind the commands, a module each: a call gives the numbers of its command."""
