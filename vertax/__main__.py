"""`python -m vertax` is the command `vertax`."""

from vertax.runs.command_line import main

main()
