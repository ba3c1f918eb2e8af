"""`python -m todframes` is the command `todframes`."""

import os
import sys

# `python -m` puts the current folder first on the import path. A dataset of unknown origin may lie there, and its
# files must not be imported; so this comes before any other import.
try:
    here = os.getcwd()  # noqa: PTH109 - pathlib would be an import
except FileNotFoundError:
    here = ""
if not sys.flags.safe_path and sys.path[0] in ("", here):
    del sys.path[0]

from todframes.cli import main

main()
