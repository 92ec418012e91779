"""The figures of experiments, from numbers made up: one scale for what is compared, and nothing left out."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

import vertax as vx
from experiments import (
    adjoint_scaling,
    benchmark_adjoints,
    compare_conditions,
    convergent_extension,
    external_tensions,
    hypergradient_accuracy,
    inference_across_topologies as topologies,
    rigidity_transition as rigidity,
    salt_and_pepper,
    tissue_moduli,
)
from vertax.jobs import design_mechanics, infer_from_microscopy
from vertax.plotting import label_colours
from vertax.tensions._mean_stress import mean_stress

pytestmark = pytest.mark.experiments

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def tissue():
    return vx.initialise.periodic_voronoi(9, key=jax.random.key(0), lloyd_steps=1)


@pytest.fixture(scope="module")
def cluster():
    return vx.initialise.free_voronoi(6, key=jax.random.key(0), lloyd_steps=1)


def panels(figure: Figure) -> list[Any]:
    """The axes, without bars."""
    figure.canvas.draw()  # all can be drawn
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def fit_with(**fields: Any) -> vx.Fit:
    """A fit that has nothing but some fields."""
    fit = object.__new__(vx.Fit)
    for name, value in fields.items():
        object.__setattr__(fit, name, value)
    return fit


def bars(figure: Figure) -> list[str]:
    return [ax.get_ylabel() for ax in figure.axes if ax.get_label() == "<colorbar>"]


def limits(axes, kind) -> set[tuple[float, float]]:
    return {c.get_clim() for ax in axes for c in ax.collections if type(c) is kind}


def test_designs_before_and_after_have_one_scale(tissue, cluster):
    observed = 3.9 + 0.1 * RNG.normal(size=(5, 9))
    shown = {"initial": (tissue, observed[0]), "designed": (tissue, observed[-1])}
    figure = design_mechanics.plot_design(
        shown, observed, observed + 0.01, ("shape_factor", observed.mean(axis=1), 4.1)
    )
    first, second, curves = panels(figure)
    ends = observed[[0, -1]]
    assert limits((first, second), PolyCollection) == {(ends.min(), ends.max())}
    assert len(curves.lines) == 9 + 3
    assert bars(figure) == [r"shape factor $P/\sqrt{A}$"]

    tension = [1 + RNG.uniform(size=cluster.n_edges) for _ in range(2)]
    both = {"initial": (cluster, tension[0]), "designed": (cluster, tension[1])}
    targets = np.array([1.75, 2.0])
    ratios = {n: targets[:, None] + 0.01 * RNG.normal(size=(2, 3)) for n in (6, 12)}
    first, second, reached, _ = panels(
        convergent_extension.plot_elongation(both, (1.0, 2.0), targets, ratios)
    )
    assert (1.0, 2.0) in limits((first, second), LineCollection)
    assert reached.get_legend_handles_labels()[1] == ["6 cells", "12 cells"]

    types = np.arange(6) % 2
    three = {name: (tissue, types, values) for name, (tissue, values) in both.items()}
    shares = {"free, 2 types": RNG.uniform(0.5, 1, (4, 3))}
    figure = salt_and_pepper.plot_patterns(three, (1.0, 2.0), shares)
    first, second, share = panels(figure)
    assert limits((first, second), PolyCollection) == {(-0.5, 3.5)}
    assert bars(figure) == [r"tension $\gamma$"]
    np.testing.assert_allclose(share.lines[0].get_ydata(), shares["free, 2 types"].mean(axis=1))


def test_a_label_image_shows_its_labels_under_the_edges(cluster):
    labels = np.repeat(np.arange(7), 10).reshape(7, 10)
    picture = label_colours(labels)
    edges, cells = np.ones(cluster.n_edges), np.ones(cluster.n_cells)
    result = vx.tensions.InferredTensions(
        tissue=cluster,
        tensions=edges,
        tension_deviations=edges,
        determined=edges > 0,
        pressures=cells,
        pressure_deviations=cells,
        pressures_determined=cells > 0,
        stresses=np.ones((cluster.n_cells, 2, 2)),
        labels=np.arange(1, 7),
        noise=0.1,
        correlation=0.1,
        edges="arcs",
        errors={"junction": 0.0, "arc": 0.0},
        mean_stress=mean_stress(np.zeros(3), np.zeros((3, 3)), 7),
        bending=0.0,
        pixel_size=0.4,
        four_fold=edges < 0,
    )
    left, right = panels(vx.plotting.plot_tensions(result, labels))
    np.testing.assert_allclose(left.images[0].get_array(), picture)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 7
    assert (left.get_xlim(), left.get_ylim()) == (right.get_xlim(), right.get_ylim())
    assert [text.get_text() for text in left.texts] == ["2 pixels"]


def test_cells_over_a_micrograph_are_those_of_the_mask(tissue):
    image = RNG.normal(size=(30, 30))
    complete = np.arange(9) < 4
    figure = infer_from_microscopy.plot_cells(image, tissue, np.arange(9.0), complete, 0.1)
    (ax,) = panels(figure)
    (faces,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    assert set(np.asarray(faces.get_array()).tolist()) == {0, 1, 2, 3}
    assert bars(figure) == ["target shape factor $p_0$"]
    shown = {"segmented": tissue, "fitted": tissue}
    axes = panels(infer_from_microscopy.plot_overlays(image, shown, pixel_size=0.1))
    assert [ax.get_title() for ax in axes] == ["segmented", "fitted"]
    assert all(len(ax.images) == 1 for ax in axes)


def test_conditions_have_one_scale_for_all_ratios(tissue):
    images = [
        SimpleNamespace(
            condition=kind,
            snr=snr,
            true=(true := mean + 0.1 * RNG.normal(size=8)),
            inferred=true + RNG.normal(size=8) / snr,
            deviation=np.full(8, 1 / snr),
        )
        for kind, mean in (("stiff", 3.6), ("fluid", 3.9))
        for snr in (20.0, 3.0)
    ]
    axes = panels(compare_conditions.plot_conditions(images))
    scatter, boxes = axes[:2], axes[2:]
    assert len({ax.get_xlim() for ax in scatter} | {ax.get_ylim() for ax in scatter}) == 1
    assert len({ax.get_ylim() for ax in boxes}) == 1
    every = np.concatenate([x for i in images for x in (i.true, i.inferred)])
    low, high = scatter[0].get_xlim()
    assert low < every.min()
    assert every.max() < high

    segmentation: Any = SimpleNamespace(pixel_size=0.1)
    outcome: Any = SimpleNamespace(tissue=tissue)
    pictures = {f"SNR {k}": (RNG.normal(size=(30, 30)), segmentation, outcome) for k in range(3)}
    with_image = [ax for ax in panels(compare_conditions.plot_images(pictures)) if ax.images]
    assert len(with_image) == 6


def test_methods_across_topologies(tissue):
    methods = ("alone", "guided")
    curves = {
        name: topologies.Curves(
            RNG.uniform(size=(6, 3)), RNG.uniform(size=(6, 3)), RNG.integers(0, 5, (6, 3))
        )
        for name in methods
    }
    metrics = {
        name: {
            "relative_error": c.relative_error[-1],
            "pearson": np.array([0.5, 0.9, 1.0]),
            "mismatched_neighbours": c.mismatched[-1],
        }
        for name, c in curves.items()
    }
    axes = panels(topologies.plot_inference(curves, metrics))
    assert len(axes) == 6
    assert axes[0].get_legend_handles_labels()[1] == list(methods)
    np.testing.assert_allclose(
        axes[0].lines[0].get_ydata(), np.exp(np.log(curves["alone"].relative_error).mean(axis=1))
    )
    energy = lambda low: vx.energies.ShapeFactorEnergy(jnp.linspace(low, 4, 9))
    scene = vx.inference.Scene(energy(3.7), tissue, energy(3.6), tissue, converged=jnp.array(True))
    fits = {"guided": fit_with(tissue=tissue, energy=energy(3.5))}
    axes = panels(topologies.plot_tissues(scene, fits))
    assert [ax.get_title() for ax in axes] == ["start", "guided", "target"]
    assert limits(axes, PolyCollection) == {(3.5, 4.0)}


def test_the_benchmark_compares_on_one_scale():
    rows = [
        {
            "protocol": protocol,
            "cells": n,
            "method": method,
            "ms_per_epoch": n * (10 if protocol == "paper" else 1),
            "ms_forward": 0.5 * n,
            "memory_kB": 3 * n,
        }
        for protocol in ("paper", "equilibrium")
        for n in (20, 50)
        for method in ("Adj-ID", "EP")
    ]
    time, memory, time_too, memory_too = panels(adjoint_scaling.plot_scaling(rows))
    assert time.get_ylim() == time_too.get_ylim()
    assert memory.get_ylim() == memory_too.get_ylim()
    assert [label.get_text() for label in time.get_xticklabels()] == ["20", "50"]

    true, initial = 3.7 + 0.1 * RNG.normal(size=(2, 2, 5))
    history = SimpleNamespace(
        cost=RNG.uniform(size=(6, 2)), relative_error=RNG.uniform(size=(6, 2))
    )
    fits = {name: fit_with(history=history) for name in ("AD", "LM")}
    inferred = {"AD": true + 0.01 * RNG.normal(size=true.shape), "LM": true}
    figure = benchmark_adjoints.plot_inference(fits, true, initial, inferred, title="here")
    start, end, *_ = panels(figure)
    assert start.get_xlim() == end.get_xlim() == start.get_ylim() == end.get_ylim()

    errors = {
        f"{n}, {e}": RNG.uniform(size=(4, 2)) for n in ("linear", "cost") for e in _ESTIMATORS
    }
    betas = {"linear": np.logspace(-6, -3, 4), "cost": np.logspace(-3, 0, 4)}
    linear, cost, _ = panels(
        hypergradient_accuracy.plot_betas(betas, errors, {1.0: {"relative_error": [1e-3, 2e-3]}})
    )
    assert linear.get_ylim() == cost.get_ylim()
    by_method = {"AD": RNG.uniform(size=(4, 2))}
    (ax,) = panels(hypergradient_accuracy.plot_accuracy(np.logspace(-6, -3, 4), by_method))
    assert ax.get_xscale() == ax.get_yscale() == "log"


_ESTIMATORS = ("centred", "one-sided")


def test_more_cycles_than_colours_are_all_drawn():
    p0 = np.linspace(3.7, 3.9, 5)
    curves = [
        rigidity.Curve(f"{k} cycles", np.linspace(0, 1, 5), 3.8, 0.01, np.linspace(1, 0, 5), None)
        for k in range(9)
    ]
    axes = panels(rigidity.plot_transition(p0, curves, RNG.uniform(size=(5, 2)), np.zeros((5, 0))))
    assert len(axes) == 3
    # Before, the sixth curve and those after it were left out without a word.
    assert len(axes[0].get_legend_handles_labels()[1]) == 9


def test_moduli_of_all_tissues_and_their_means():
    p0, shear = np.linspace(3.5, 4.0, 4), RNG.uniform(size=(4, 3))
    shear[3, 1] = np.nan
    means = {name: np.arange(4.0) for name in ("shear", "affine", "bulk", "tension")}
    left, _, right = panels(tissue_moduli.plot_moduli(p0, shear, means, np.array([1, 1, 0.5, 0])))
    np.testing.assert_allclose(left.lines[0].get_ydata(), shear.ravel())
    assert [text.get_text() for text in left.get_legend().get_texts()] == [
        "relaxed",
        "affine",
        "hexagons",
    ]
    np.testing.assert_allclose(right.lines[0].get_ydata(), [1, 1, 0.5, 0])


def test_tensions_through_another_program_are_beside_those_through_vertax(tissue):
    true = RNG.uniform(0.2, 0.4, tissue.n_edges)
    inferred = {"Surface Evolver": true + 0.01, "vertax": true}
    errors = dict.fromkeys(inferred, np.geomspace(0.1, 0.01, 5))
    foam, recovered, history = panels(
        external_tensions.plot_recovery(tissue, true, inferred, errors)
    )
    del foam
    lines = [line for line in recovered.lines if len(line.get_xdata()) == tissue.n_edges]
    np.testing.assert_array_equal([line.get_ydata() for line in lines], list(inferred.values()))
    assert len(history.lines) == 2
