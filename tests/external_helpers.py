"""Shared by the tests of external programs: one in NumPy and SciPy."""

import os
import time

import equinox as eqx
import numpy as np
import scipy.optimize as so

from vertax.external import AbstractSimulator, Edges, Relaxed


class Foam(AbstractSimulator):
    """Areas and tensions, relaxed by SciPy.

    `noise` displaces what it returns, as a program does that stops too early. In another `mood` than "" it
    goes wrong in the way of that name; where the first tension is negative, always.
    """

    def __init__(self, noise=0.0, mood=""):
        self.noise = noise
        self.mood = mood

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
        turned = lambda v: np.stack([v[..., 1], -v[..., 0]], axis=-1)
        by_corner = np.sum(pressure, axis=1)[:, None] * turned(d)
        by_vector = -np.sum(pressure[..., None] * turned(corners), axis=1)
        by_vector += (tension.tension / lengths)[:, None] * d
        slope = -forces
        np.add.at(slope, edges.ends[:, 0], by_corner - by_vector)
        np.add.at(slope, edges.ends[:, 1], by_vector)
        return value - np.sum(forces * x), slope.ravel()

    def relax(self, tissue, energy, forces):
        self.go_wrong(energy, forces)
        wrong = {
            "shape": tissue.vertices[1:],
            "nan": np.full_like(tissue.vertices, np.nan),
            "text": np.full(tissue.vertices.shape, "here"),
            "no rest": tissue.vertices
            + 0.01 * np.sin(np.arange(tissue.vertices.size)).reshape(-1, 2),
        }
        if self.mood in wrong:
            return wrong[self.mood]
        edges = Edges.of(tissue)
        pull = np.zeros_like(tissue.vertices) if forces is None else forces
        args = (edges, energy, pull)
        x = tissue.vertices.ravel()
        found = so.minimize(self.value_and_slope, x, args=args, jac=True, method="BFGS")
        x = found.x
        # BFGS ends where rounding of the energy begins; Newton's method goes on.
        for _ in range(3):
            near = 1e-5 * np.eye(x.size)
            hessian = [(self.slope(x + e, *args) - self.slope(x - e, *args)) / 2e-5 for e in near]
            x = x - np.linalg.pinv(np.array(hessian), rcond=1e-8) @ self.slope(x, *args)
        x = x + self.noise * np.random.default_rng(0).standard_normal(x.size)
        unpulled = self.value_and_slope(x, edges, energy, 0 * pull)[0]
        return Relaxed(x.reshape(-1, 2), energy=unpulled, num_steps=found.nit)

    def go_wrong(self, energy, forces):
        if self.mood == "dies" or (self.mood == "ill" and energy.terms[1].tension[0] < 0.1):
            os._exit(3)
        if self.mood == "hangs" or (self.mood == "ill" and energy.terms[1].tension[0] < 0.2):
            time.sleep(600)
        if self.mood == "times out":
            raise TimeoutError("the reactor does not answer")
        if self.mood == "raises" or (self.mood == "when pulled" and forces is not None):
            raise OSError("the reactor is too hot")
        if energy.terms[1].tension[0] < 0:
            raise ValueError("a tension is negative")

    def parameter_gradient(self, tissue, energy):
        vertices = np.asarray(tissue.vertices)
        lengths = np.hypot(*Edges.of(tissue).vectors(vertices).T)
        return eqx.tree_at(lambda e: e.terms[1].tension, energy, lengths)

    def energy(self, tissue, energy):
        if self.mood == "endless":
            return np.nan
        forces = np.zeros_like(tissue.vertices)
        return self.value_and_slope(tissue.vertices, Edges.of(tissue), energy, forces)[0]
