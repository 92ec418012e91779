"""A whole experiment in a folder: what it leaves there, and that it is right."""

import json
import tomllib

import equinox as eqx
import jax
import numpy as np
import pytest
from run_helpers import run, table

import vertax as vx
from vertax.runs import RunFolder, load_config
from vertax.runs._execution import new_folder
from vertax.runs._folder import RunFolderError
from vertax.runs._tables import summary

pytestmark = pytest.mark.experiments

TINY = """
experiment = "infer_shape_factors"
data = "both"
tissue.n_cells = 6
image = { pixels = 48, noise = 0.02 }
relaxation = { contacts = false }  # which compiles less
fit.epochs = 4
"""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A finished run: its folder and its metrics."""
    base = tmp_path_factory.mktemp("tiny")
    (base / "tiny.toml").write_text(TINY)
    return run(base / "tiny.toml", base / "out")


def test_a_run_writes_all_files(tiny):
    folder, _ = tiny
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {
        "unfinished/image.npz",  # the command line removes what only an unfinished run needs
        "unfinished/vertices.npz",
        "config.toml",
        "metrics.json",
        "history.csv",
        "shape_factors.csv",
        "image.npy",
        "initial.npz",
        "target.npz",
        "fitted_vertices.npz",
        "fitted_image.npz",
        "figures/target.png",
        "figures/overlay_image.png",
        *(
            f"figures/{name}_{source}.png"
            for name in ("before_after", "convergence", "recovery")
            for source in ("vertices", "image")
        ),
    }


@pytest.mark.parametrize("source", ["vertices", "image"])
def test_metrics_agree_with_the_saved_tissues(tiny, source):
    folder, metrics = tiny
    shape_factors = {k: np.array(v, float) for k, v in table(folder / "shape_factors.csv").items()}
    true, inferred = shape_factors["true"], shape_factors[f"inferred_{source}"]
    fitted = vx.load(folder / f"fitted_{source}.npz", vx.Tissue)
    energy = vx.energies.ShapeFactorEnergy(inferred)
    force = eqx.filter_jit(jax.grad(lambda x: energy(fitted.with_configuration(x))))(
        fitted.configuration
    )
    reported = metrics[source]
    assert np.abs(force).max() == pytest.approx(reported["max_force"], abs=1e-12)
    assert reported["max_force"] < 1e-9
    assert reported["pearson"] == pytest.approx(np.corrcoef(true, inferred)[0, 1])
    assert reported["relative_error"] == pytest.approx(np.mean(np.abs(inferred - true) / true))
    assert reported["relative_error"] < reported["relative_error_initial"]
    assert reported["cost_final"] < reported["cost_initial"]
    assert reported["epochs"] == 4
    assert reported["seconds_per_epoch"] > 0
    assert reported["converged_fraction"] == 1
    if source == "vertices":
        cost = vx.costs.VertexDistance(vx.load(folder / "target.npz", vx.Tissue))
        assert float(cost(fitted, energy)) == pytest.approx(reported["cost_final"])
    else:
        width = 2.0 * np.sqrt(6) / 48
        cost = vx.costs.MeshImage(np.load(folder / "image.npy"), width)
        assert float(eqx.filter_jit(cost)(fitted, energy)) == pytest.approx(reported["cost_final"])


def test_the_target_is_an_equilibrium_of_the_true_parameters(tiny):
    folder, _ = tiny
    true = np.array(table(folder / "shape_factors.csv")["true"], float)
    target = vx.load(folder / "target.npz", vx.Tissue)
    # The settings of the experiment: then nothing is compiled again.
    relaxation = load_config(folder / "config.toml")[1].relaxation.build()
    equilibrium = relaxation(
        target, vx.energies.ShapeFactorEnergy(jax.numpy.asarray(true)), throw=False
    )
    assert bool(equilibrium.converged)
    assert int(equilibrium.num_steps) == 0


def test_history_has_a_row_for_each_epoch_of_each_fit(tiny):
    folder, metrics = tiny
    history = table(folder / "history.csv")
    assert history["data"] == 4 * ["vertices"] + 4 * ["image"]
    assert history["epoch"] == 2 * ["0", "1", "2", "3"]
    assert float(history["cost"][0]) == metrics["vertices"]["cost_initial"]
    assert metrics["pearson"] == metrics["vertices"]["pearson"]
    assert float(history["relative_error"][4]) == metrics["image"]["relative_error_initial"]


def test_the_resolved_configuration_repeats_the_run(tiny):
    folder, metrics = tiny
    again, repeated = run(folder / "config.toml", folder.parent / "again", "data=vertices")
    # The warning that four epochs are too few has no name of a fit.
    left_out = ("seconds_per_epoch", "warnings")
    timeless = lambda numbers: {k: v for k, v in numbers.items() if k not in left_out}
    # One kind of data: its metrics are at the top, and its files need no name to distinguish them.
    assert timeless(repeated) == timeless(metrics["vertices"])
    assert (again / "fitted.npz").is_file()
    assert not (again / "image.npy").exists()
    written = tomllib.loads((again / "config.toml").read_text())
    assert written["data"] == "vertices"
    assert written["relaxation"]["t1_threshold"] == vx.T1().threshold


def test_figures_are_pictures(tiny):
    folder, _ = tiny
    for path in (folder / "figures").iterdir():
        assert path.read_bytes().startswith(b"\x89PNG"), path


# --- run folders


def test_an_earlier_run_is_not_overwritten_by_default(tmp_path):
    claim = lambda **options: new_folder(tmp_path / "demo", **options)
    first = claim()
    assert first == tmp_path / "demo"
    assert claim() == first  # still empty
    (first / "config.toml").write_text("")
    assert claim().name == "demo-2"
    (tmp_path / "demo-2" / "metrics.json").write_text("")
    assert claim().name == "demo-3"
    with pytest.raises(RunFolderError, match=r"not empty.*--overwrite"):
        claim(output=first)
    assert (first / "config.toml").exists()


def test_overwriting_removes_a_run_and_nothing_else(tmp_path):
    results = ("config.toml", "metrics.json", "fitted.npz", "history.csv", "figures/a.png")
    (tmp_path / "figures").mkdir()
    for name in (*results, "notes.txt"):
        (tmp_path / name).write_text("old")
    new_folder(tmp_path / "demo", tmp_path, overwrite=True)
    assert (tmp_path / "notes.txt").exists()
    assert not any((tmp_path / name).exists() for name in results)


def test_a_folder_that_holds_no_run_is_not_overwritten(tmp_path):
    (tmp_path / "thesis.csv").write_text("years")
    with pytest.raises(RunFolderError, match="holds no run"):
        new_folder(tmp_path / "demo", tmp_path, overwrite=True)
    assert (tmp_path / "thesis.csv").exists()


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(RunFolderError, match="there is a file of that name"):
            new_folder(tmp_path / "demo", output)
    with pytest.raises(RunFolderError, match="there is a file of that name"):
        new_folder(tmp_path / "file" / "demo")


def test_metrics_are_strict_json(tmp_path):
    values = {"a": np.float64("nan"), "b": {"c": [np.inf, np.int64(3)]}, "d": jax.numpy.ones(2)}
    RunFolder(tmp_path).save_metrics(values | {"e": np.bool_(True), "f": "x"})
    text = (tmp_path / "metrics.json").read_text()
    expected = {"a": None, "b": {"c": [None, 3]}, "d": [1.0, 1.0], "e": True, "f": "x"}
    assert json.loads(text) == expected


def test_columns_of_a_table_have_one_length(tmp_path):
    with pytest.raises(ValueError, match="columns of one length"):
        RunFolder(tmp_path).save_table("x", {"a": [1, 2], "b": [1]})
    assert not list(tmp_path.iterdir())


def test_a_summary_shows_the_numbers():
    single = summary({"cost": 1.23456, "ok": True, "name": "x"})
    assert single.split() == ["cost", "1.235"]
    grouped = summary({"a": {"cost": 1.0}, "b": {"cost": 2, "error": None}})
    assert grouped.split() == ["a", "b", "cost", "1", "2"]
    assert summary({"ok": "yes"}) == ""
