"""The sparse solution of the balance of forces, compared with a dense one."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls
from scipy.sparse import csc_array, csr_array, diags_array, eye_array, kron

from vertax._base.sparse_normal import SparseNormal
from vertax.inference import label_image
from vertax.initialise import from_labels
from vertax.io import read_surface_evolver
from vertax.tensions import _infer_tensions, infer_tensions
from vertax.tensions._balance import equations, force_slopes, forces
from vertax.tensions._curves import Points, read_courses
from vertax.tensions._edges import solution
from vertax.tensions._infer_tensions import _of_foam, _of_mask
from vertax.tensions._observed_geometry import observed_geometry
from vertax.tensions._solve import HIDDEN, System, solve

DATA = Path(__file__).parents[3] / "shared" / "data" / "surface_evolver"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="the data beside the repository, ../shared/data, are not there"
)


def dense(system, errors, rounds):
    """Tensions, pressures and their covariance by dense matrices, as total least squares is documented."""
    shape, which, n = system.shape, system.which, system.n_edges
    unknown = 100 * (shape.loose_forces @ shape.loose_forces.T).toarray()
    regions = np.linalg.inv(system.root.toarray()) * system.scale
    cells = system.n_cells
    prior = np.zeros(2 * (n + cells,))
    tension = errors.tension**2 * np.eye(n) + errors.region**2 * regions @ regions.T
    prior[:n, :n] = np.linalg.inv(tension)
    prior[n:, n:] = (shape.size / errors.pressure) ** 2 * np.eye(cells)
    expected = np.append(np.ones(n), np.zeros(cells))
    mean = np.append(np.full(n, 1 / n), np.zeros(cells))
    model = shape.model_deviations(errors._replace(arc=HIDDEN * errors.arc))
    spread = errors.noise**2 * shape.covariance() + np.diag(model**2)
    x, change, inverse = expected, np.zeros(len(shape.angle)), prior
    for _ in range(rounds):
        matrix = forces(shape.angle + change, which, shape.loose).toarray()
        slope = force_slopes(shape.angle + change, which, np.maximum(x[:n], 0.2)).toarray()
        offset = -slope @ change
        root = np.linalg.cholesky(slope @ spread @ slope.T + unknown)
        white, given = np.linalg.solve(root, matrix), np.linalg.solve(root, offset)
        normal = white.T @ white + prior
        heavy = 1e3 * np.trace(normal) / len(normal) * n**2
        right = prior @ expected - white.T @ given + heavy * mean
        normal += heavy * np.outer(mean, mean)
        inverse = cho_solve(cho_factor(normal), np.eye(len(x)))
        # Pressures of any sign are differences of two positive numbers.
        both = np.hstack([np.eye(n + cells), -np.eye(n + cells)[:, n:]])
        upper = np.linalg.cholesky(normal).T
        split = nnls(upper @ both, np.linalg.solve(upper.T, right), maxiter=10**5)[0]
        x = both @ split
        residual = white @ x + given
        change = -spread @ slope.T @ np.linalg.solve(root.T, residual)
        change *= min(1.0, 0.5 / np.max(np.abs(change)))
    return x, np.sqrt(np.diag(inverse))


def system_of(course, straight, prior=None):
    """The sum of squares of a tissue, and the errors chosen by the evidence."""
    geometry = observed_geometry(course.tissue, course.labels == 0)
    used = np.isin(course.points.edge, equations(geometry).edges)
    points = Points(*(of[used] for of in course.points))
    curves = read_courses(geometry, points, course.grain, apart=course.apart, noise=course.noise)
    uncertain = np.zeros(course.tissue.n_edges, bool)
    options = {"straight": straight, "known_noise": False, "prior": prior}
    system, balance = solution(geometry, curves, uncertain, **options)
    return system, balance.errors


@needs_data
@pytest.mark.parametrize(
    ("name", "pixels", "straight", "prior"),
    [
        pytest.param("movie_3", None, False, None, marks=pytest.mark.thorough),
        pytest.param("movie_6", 700, False, None, marks=pytest.mark.thorough),
        pytest.param("movie_3", 400, False, None, marks=pytest.mark.thorough),
        pytest.param("movie_6", 700, True, None, marks=pytest.mark.thorough),
        ("movie_4", None, False, 0.4),
    ],
)
@pytest.mark.thorough
def test_the_sparse_solution_is_the_dense_one(name, pixels, straight, prior):
    foam = read_surface_evolver(DATA / f"{name}.dmp")
    if pixels is None:
        course = _of_foam(foam, None)
    else:
        image = label_image(foam, pixels)
        course = _of_mask(from_labels(image, boundary="free", inner_arcs=True), None)
    system, errors = system_of(course, straight, prior)
    if prior is not None:
        system = System(system.shape, system.which, regional=True)
        errors = errors._replace(region=0.3)
    balance = solve(system, errors)
    x, deviation = dense(system, errors, 20)
    n = system.n_edges
    assert np.max(np.abs(balance.tension - x[:n]) / deviation[:n]) < 0.1
    away = balance.pressure - x[n:]
    assert np.max(np.abs(away - away.mean()) / deviation[n:]) < 0.1
    sparse = np.sqrt(balance.posterior.variances())
    # The sparse solution ends when 99 % of the tensions change by less than 0.001.
    np.testing.assert_allclose(sparse, deviation, rtol=3e-2)


@pytest.mark.thorough
def test_variances_of_windows_are_those_of_the_inverse():
    n = 60
    line = diags_array(
        [-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)],
        offsets=np.array([-1, 0, 1]),  # pyright: ignore[reportArgumentType]
    )
    precision = csc_array(
        kron(line, eye_array(n)) + kron(eye_array(n), line) + 0.05 * eye_array(n**2)
    )
    place = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1)
    rows = csr_array(eye_array(n**2) + eye_array(n**2, k=1))
    variances = SparseNormal(precision, place.reshape(-1, 2).astype(float)).variances(rows)
    exact = np.diag(rows @ np.linalg.inv(precision.toarray()) @ rows.T.toarray())
    assert np.sqrt(np.mean((variances / exact - 1) ** 2)) < 0.02


def test_a_mask_too_large_for_the_memory_is_refused(monkeypatch):
    monkeypatch.setattr("vertax._base.available_memory.available_memory", lambda: 10**8)
    with pytest.raises(MemoryError, match=r"takes about 0\.4 GB and 0\.1 GB are available"):
        infer_tensions(np.kron(np.arange(1, 10).reshape(3, 3), np.ones((20, 20), int)))


def test_phases_are_named_on_a_terminal(monkeypatch, foam):
    names = []
    monkeypatch.setattr(_infer_tensions, "start_phase", names.append)
    infer_tensions(label_image(foam[0], 200))
    assert names == ["reading", "outlines", "geometry", "balance", "errors"]
