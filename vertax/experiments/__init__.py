"""The experiments of `vertax run`: clients of the public packages, one folder each."""
