"""Tables of movies for the tests."""

from typing import Any

import numpy as np

from vertax.mesh import cell_polygons


def rows_of(tissue, frame, numbers=None, leave_out=(), points: Any = 1, **columns):
    """The rows of the corners of a frame, or of several points of each edge."""
    numbers = np.arange(tissue.n_cells) if numbers is None else numbers
    polygons, sizes = cell_polygons(tissue, points)
    return [
        {"frame": frame, "cell": int(number), "x": x, "y": y}
        | {name: values[k] for name, values in columns.items()}
        for k, (number, polygon, size) in enumerate(zip(numbers, polygons, sizes, strict=True))
        if number not in leave_out
        for x, y in polygon[:size]
    ]


def table_of(rows):
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
