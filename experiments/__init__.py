"""Experiments that reproduce a figure or check a claim; `vertax run` runs them from the repository."""
