"""Arguments of the scripts."""

from __future__ import annotations

import argparse


def count(text: str) -> int:
    """A positive integer, for `argparse`."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, and not {number}")
    return number
