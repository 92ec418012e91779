"""A simulator in NumPy and SciPy, for the tests of external programs."""

import os
import time

import equinox as eqx
import numpy as np
import scipy.optimize as so

from vertax.external import AbstractSimulator, Edges, Relaxed


class Foam(AbstractSimulator):
    """Area elasticity and line tensions, relaxed by SciPy.

    `noise` displaces the result, as a program does that stops too early. `failure` selects a failure by name;
    "" for none. A negative first tension always fails.
    """

    def __init__(self, noise=0.0, failure=""):
        self.noise = noise
        self.failure = failure

    def slope(self, x, edges, energy, forces):
        return self.value_and_slope(x, edges, energy, forces)[1]

    def value_and_slope(self, x, edges, energy, forces):
        area, tension = energy.terms
        x = x.reshape(-1, 2)
        d = edges.vectors(x)
        lengths = np.hypot(*d.T)
        excess = edges.areas(x) - area.target_area
        value = tension.tension @ lengths + 0.5 * np.sum(area.stiffness * excess**2)
        pressure = np.append(area.stiffness * excess, 0)[edges.cells] * [0.5, -0.5]
        corners = x[edges.ends[:, 0], None] + edges.shifts
        rotated = lambda v: np.stack([v[..., 1], -v[..., 0]], axis=-1)
        by_corner = np.sum(pressure, axis=1)[:, None] * rotated(d)
        by_vector = -np.sum(pressure[..., None] * rotated(corners), axis=1)
        by_vector += (tension.tension / lengths)[:, None] * d
        slope = -forces
        np.add.at(slope, edges.ends[:, 0], by_corner - by_vector)
        np.add.at(slope, edges.ends[:, 1], by_vector)
        return value - np.sum(forces * x), slope.ravel()

    def relax(self, tissue, energy, forces):
        self.fail_as_requested(energy, forces)
        invalid_results = {
            "shape": tissue.vertices[1:],
            "nan": np.full_like(tissue.vertices, np.nan),
            "text": np.full(tissue.vertices.shape, "here"),
            "not at rest": tissue.vertices
            + 0.01 * np.sin(np.arange(tissue.vertices.size)).reshape(-1, 2),
        }
        if self.failure in invalid_results:
            return invalid_results[self.failure]
        edges = Edges.of(tissue)
        nudge = np.zeros_like(tissue.vertices) if forces is None else forces
        args = (edges, energy, nudge)
        x = tissue.vertices.ravel()
        minimum = so.minimize(self.value_and_slope, x, args=args, jac=True, method="BFGS")
        x = minimum.x
        # BFGS stops at the rounding error of the energy; Newton steps improve the result.
        for _ in range(3):
            displacements = 1e-5 * np.eye(x.size)
            hessian = [
                (self.slope(x + e, *args) - self.slope(x - e, *args)) / 2e-5 for e in displacements
            ]
            x = x - np.linalg.pinv(np.array(hessian), rcond=1e-8) @ self.slope(x, *args)
        x = x + self.noise * np.random.default_rng(0).standard_normal(x.size)
        energy_without_nudge = self.value_and_slope(x, edges, energy, 0 * nudge)[0]
        return Relaxed(x.reshape(-1, 2), energy=energy_without_nudge, num_steps=minimum.nit)

    def fail_as_requested(self, energy, forces):
        if self.failure == "dies" or (
            self.failure == "by tension" and energy.terms[1].tension[0] < 0.1
        ):
            os._exit(3)
        if self.failure == "hangs" or (
            self.failure == "by tension" and energy.terms[1].tension[0] < 0.2
        ):
            time.sleep(600)
        if self.failure == "times out":
            raise TimeoutError("the reactor does not answer")
        if self.failure == "raises" or (self.failure == "when nudged" and forces is not None):
            raise OSError("the reactor is too hot")
        if energy.terms[1].tension[0] < 0:
            raise ValueError("a tension is negative")

    def parameter_gradient(self, tissue, energy):
        vertices = np.asarray(tissue.vertices)
        lengths = np.hypot(*Edges.of(tissue).vectors(vertices).T)
        return eqx.tree_at(lambda e: e.terms[1].tension, energy, lengths)

    def energy(self, tissue, energy):
        if self.failure == "nan energy":
            return np.nan
        forces = np.zeros_like(tissue.vertices)
        return self.value_and_slope(tissue.vertices, Edges.of(tissue), energy, forces)[0]
