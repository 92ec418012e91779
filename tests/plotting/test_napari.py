"""The layer of napari; and the widget, where napari is installed."""

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from vertax.initialise import from_labels
from vertax.plotting import tension_layer
from vertax.tensions import infer_tensions


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
    features = options["features"]
    assert len(paths) == inferred.tissue.n_edges == len(features["tension"])
    assert features.keys() >= {options["edge_color"]}
    shown = features[options["edge_color"]]
    np.testing.assert_array_equal(np.isfinite(shown), inferred.determined)
    assert options["edge_contrast_limits"][0] == np.nanmin(shown)
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
import vertax, pathlib, threading
manager = PluginManager.instance()
manager.register(PluginManifest.from_file(pathlib.Path(vertax.__file__).parent / "napari.yaml"))
viewer = napari.Viewer(show=False)
mask = np.load("mask.npy")
layer = viewer.add_labels(np.stack([mask, mask[::-1]]), name="cells", scale=(1, 2, 2))
_, widget = viewer.window.add_plugin_dock_widget("vertax", "Tensions of edges")
widget.cells.value = layer
widget.frames.value = "all"
compiling = set()
listen = lambda event, _, **__: "compile" in event and compiling.add(threading.current_thread())
jax.monitoring.register_event_duration_secs_listener(listen)
widget.infer()
assert len(viewer.layers) == 1  # the window is not blocked
from qtpy.QtWidgets import QApplication
import time
end = time.time() + 200
while widget.tensions is None and time.time() < end:
    QApplication.instance().processEvents()
    time.sleep(0.01)
assert compiling and threading.main_thread() not in compiling
shapes, pressures = viewer.layers["tensions"], viewer.layers["pressures"]
assert shapes.edge_color_mode == "colormap"
determined = shapes.features["determined"].to_numpy()
np.testing.assert_array_equal(shapes.edge_color[~determined][:, :3], 0.5)
assert len(np.unique(shapes.edge_color[determined], axis=0)) > 1
assert tuple(shapes.scale) == (1, 2, 2)
# A pixel has the number of the row of its cell.
data, table = layer.data, pressures.features
np.testing.assert_array_equal(table["label"].to_numpy()[pressures.data[data > 0]], data[data > 0])
np.testing.assert_array_equal(table["frame"].to_numpy()[pressures.data[1][data[1] > 0]], 1)
assert not widget.bars.native.isHidden() and not layer.visible
widget.write()  # without a folder
assert not list(pathlib.Path(".").glob("*.csv"))
widget.file.value = "tables"
widget.write()
assert (pathlib.Path("tables") / "columns.csv").exists()
print(np.sum(shapes.features["frame"] == 0), "edges")
viewer.close()
"""


@pytest.mark.slow
def test_the_widget_runs_in_napari(tmp_path):
    # Another interpreter may have napari: the tests do not depend on it.
    interpreter = os.environ.get("NAPARI_PYTHON", sys.executable)
    if interpreter == sys.executable and importlib.util.find_spec("napari") is None:
        pytest.skip("napari is not installed: pip install -e '.[napari]', or name a NAPARI_PYTHON")
    if not os.environ.get("DISPLAY") and sys.platform == "linux":
        pytest.skip("colours of labels in napari need a display with OpenGL: run under xvfb-run")
    np.save(tmp_path / "mask.npy", bricks())
    process = subprocess.run(
        [interpreter, "-c", WIDGET],
        cwd=tmp_path,
        env=os.environ | {"NAPARI_ASYNC": "0"},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[-1].startswith(f"{infer_tensions(bricks()).tissue.n_edges} ")
