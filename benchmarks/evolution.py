"""Time integration: time of a step relative to a relaxation, and of a gradient relative to the simulation.

    python benchmarks/evolution.py [--cells 100 1000] [--steps 20]

A random tissue relaxes against friction over five units of time in `--steps` steps. Printed are:

- steps per second;
- time of one step relative to a relaxation from the same start;
- time of a gradient with respect to all target shape factors and the friction, relative to the simulation;
- memory of the gradient for each step, from XLA;
- number of T1 transitions;
- evaluations of the velocities per second (`vx.mechanics.velocities`), and steps per second of Diffrax with
  the explicit Euler method, which needs one evaluation for each step;
- simulated time per second with the implicit steps, and with the largest stable explicit steps, 2 ζ / λ,
  where λ is the largest eigenvalue of the Hessian.
"""

import argparse

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from _arguments import count
from _timing import first_and_best

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure time integration.")
    parser.add_argument("--cells", type=count, nargs="+", default=[100, 1000])
    parser.add_argument("--steps", type=count, default=20)
    chosen = parser.parse_args()
    print(
        "cells  steps/s  step/relaxation  gradient/forward  kB a step  T1s  velocities/s  explicit steps/s  "
        "time/s implicit  explicit"
    )
    best = lambda *call: first_and_best(*call, repeats=3)[1]
    for n_cells in chosen.cells:
        tissue = vx.initialise.periodic_voronoi(n_cells=n_cells, key=0)
        parameters = (jnp.full(n_cells, 3.7), jnp.array(1.0))
        times = jnp.linspace(0, 5, chosen.steps + 1)

        def movie(parameters, times, tissue=tissue):
            targets, friction = parameters
            energy = vx.energies.ShapeFactorEnergy(targets)
            dissipation = vx.dissipations.SubstrateFriction(friction)
            return vx.evolve(tissue, energy, dissipation, times, throw=False)

        def cost(parameters, times, movie=movie):
            return jnp.sum(movie(parameters, times).tissue.perimeters ** 2)

        forward = eqx.filter_jit(lambda p, t, movie=movie: movie(p, t).tissue.vertices)
        gradient = eqx.filter_jit(jax.grad(cost))
        relax = eqx.filter_jit(
            lambda p, tissue=tissue: (
                vx.equilibrate(
                    tissue, vx.energies.ShapeFactorEnergy(p[0]), throw=False
                ).tissue.vertices
            )
        )
        step = best(forward, parameters, times) / chosen.steps
        relaxation = best(relax, parameters)
        back = best(gradient, parameters, times) / chosen.steps
        sizes = []
        for part in (times, times[: chosen.steps // 2 + 1]):
            analysis = jax.jit(jax.grad(cost)).lower(parameters, part).compile().memory_analysis()
            sizes.append(analysis.temp_size_in_bytes if analysis else float("nan"))
        kept = (sizes[0] - sizes[1]) / (chosen.steps - chosen.steps // 2)
        num_t1 = movie(parameters, times).num_t1
        explicit, velocity, stable = _explicit(movie(parameters, times).tissue, parameters, best)
        print(
            f"{n_cells:5d}  {1 / step:7.1f}  {step / relaxation:15.2f}  {back / step:16.2f}  "
            f"{kept / 1e3:9.1f}  {num_t1:3d}  {1 / velocity:12.0f}  {1 / explicit:16.0f}  "
            f"{5 / chosen.steps / step:15.2f}  {stable / explicit:8.2f}",
            flush=True,
        )


def _explicit(tissue, parameters, best, n_steps=100):
    """Seconds of an explicit Euler step of Diffrax and of one velocity, and the longest stable step."""
    energy = vx.energies.ShapeFactorEnergy(parameters[0])
    friction = vx.dissipations.SubstrateFriction(parameters[1])
    slope = jax.grad(lambda x: energy(tissue.with_vertices(x)))

    @jax.jit
    def stiffest(v):
        push = lambda v: jax.jvp(slope, (tissue.vertices,), (v,))[1]
        turn = lambda _, v: push(v) / jnp.linalg.norm(push(v))
        return jnp.vdot(v := jax.lax.fori_loop(0, 200, turn, v), push(v))

    start = jax.random.normal(jax.random.key(0), tissue.vertices.shape)
    stable = float(2 * parameters[1] / stiffest(start / jnp.linalg.norm(start)))
    dt = 0.5 * stable
    at = lambda x: vx.mechanics.velocities(tissue.with_vertices(x), energy, friction, throw=False)

    @jax.jit
    def march(x):
        term = diffrax.ODETerm(lambda t, x, args: at(x))
        solution = diffrax.diffeqsolve(
            term, diffrax.Euler(), 0.0, n_steps * dt, dt, x, max_steps=n_steps + 1
        )
        return solution.ys

    return best(march, tissue.vertices) / n_steps, best(jax.jit(at), tissue.vertices), stable


if __name__ == "__main__":
    main()
