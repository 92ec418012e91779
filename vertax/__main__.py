"""The command `vertax`, which is `python -m vertax` as well."""

from __future__ import annotations

import sys

from vertax._base.extras import needing


def main() -> None:
    """Entry point of the program `vertax`."""
    try:
        with needing("run", "The command `vertax`"):
            from vertax.runs.command_line import app
        app()
    except ImportError as error:
        if "pip install" not in str(error):
            raise
        sys.exit(f"Error: {error}")  # an extra is missing, here or in what a command imports


if __name__ == "__main__":
    main()
