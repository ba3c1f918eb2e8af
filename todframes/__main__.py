"""`python -m todframes` is the command `todframes`."""

from todframes.cli import main

main()
