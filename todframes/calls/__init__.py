"""The Python calls behind the commands, a module for each: a call gives the numbers of its command."""
