"""The layer of napari; and the widget, where napari is installed."""

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from vertax.inference import infer_tensions
from vertax.initialise import from_labels
from vertax.plotting import tension_layer


def bricks() -> np.ndarray:
    """Nine cells in three rows, shifted against each other."""
    rows = [
        np.roll(np.repeat([3 * r + 1, 3 * r + 2, 3 * r + 3, 0], 20), 10 * (r % 2)) for r in range(3)
    ]
    return np.pad(np.repeat(np.array(rows), 20, axis=0), 6)


def test_a_layer_has_each_edge_where_it_is_in_the_image():
    mask = bricks()
    inferred = infer_tensions(mask)
    paths, options, kind = tension_layer(inferred)
    assert kind == "shapes"
    assert len(paths) == inferred.tissue.n_edges == len(options["edge_color"])
    assert len(options["features"]["tension"]) == len(paths)
    # An edge in the middle lies between its two labels.
    inner = np.flatnonzero(inferred.determined)
    assert inner.size
    for edge in inner:
        path = paths[edge]
        middle = path[len(path) // 2]
        row, column = np.rint(middle).astype(int)
        near = mask[row - 2 : row + 3, column - 2 : column + 3]
        sides = options["features"]["left_label"][edge], options["features"]["right_label"][edge]
        assert set(sides) <= set(near.ravel().tolist())
    unknown = options["edge_color"][~inferred.determined]
    assert np.ptp(unknown[:, :3]) == 0


def test_layer_of_a_tissue_without_an_image_raises():
    tissue = from_labels(bricks(), boundary="free", inner_arcs=True).tissue
    with pytest.raises(ValueError, match="no pixels"):
        tension_layer(infer_tensions(tissue))


WIDGET = """
import numpy as np, napari
from napari.layers import Labels
from npe2 import PluginManager, PluginManifest
import jax
jax.config.update("jax_enable_x64", True)
import vertax, pathlib
manager = PluginManager.instance()
manager.register(PluginManifest.from_file(pathlib.Path(vertax.__file__).parent / "napari.yaml"))
viewer = napari.Viewer(show=False)
layer = viewer.add_labels(np.load("mask.npy"), name="cells", scale=(2, 2))
_, widget = viewer.window.add_plugin_dock_widget("vertax", "Tensions of edges")
widget.cells.value = layer
widget()
shapes = viewer.layers["tensions"]
assert "pressure" in viewer.layers["pressures"].features
assert tuple(shapes.scale) == (2, 2)
print(len(shapes.data), "edges")
viewer.close()
"""


@pytest.mark.slow
def test_the_widget_runs_in_napari(tmp_path):
    # Another interpreter may have napari: the tests do not depend on it.
    interpreter = os.environ.get("NAPARI_PYTHON", sys.executable)
    if interpreter == sys.executable and importlib.util.find_spec("napari") is None:
        pytest.skip(
            "napari is not installed: pip install 'vertax[napari]', or name a NAPARI_PYTHON"
        )
    np.save(tmp_path / "mask.npy", bricks())
    process = subprocess.run(
        [interpreter, "-c", WIDGET],
        cwd=tmp_path,
        env=os.environ | {"QT_QPA_PLATFORM": "offscreen", "NAPARI_ASYNC": "0"},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[-1].startswith(f"{infer_tensions(bricks()).tissue.n_edges} ")
