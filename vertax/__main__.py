"""`python -m vertax` is the command `vertax`."""

from vertax.experiments.command_line import main

main()
