"""The command `vertax`, which is `python -m vertax` as well."""

from __future__ import annotations

import sys

from vertax._base.extras import needing


def main() -> None:
    """Entry point of the program `vertax`."""
    try:
        with needing("run", "The command `vertax`"):
            from vertax.runs.command_line import app
    except ImportError as error:
        sys.exit(f"Error: {error}")
    app()


if __name__ == "__main__":
    main()
