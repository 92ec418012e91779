r"""Mechanics of fly wings by two posteriors: forward model and force balance.

Each wing is a free tissue of straight edges; the cells at its outline are pinned. With areas in units of the
mean observed one, and $\bar P$ the mean perimeter, the energy is

$$E = \tfrac12 \sum_c (A_c - 1 - s\,(a_c - 1))^2
    + T \Bigl[(1 - g) \sum_e \ell_e + \frac{g}{4 \bar P} \sum_c P_c^2\Bigr]$$

- $T$: mean tension of the edges;
- $g$: share of the tension that is proportional to the perimeters of the two cells;
- $s$: share of the deviation of an observed area $a_c$ that the target area has.

The forward model compares equilibrium and observed vertices, with noise of positions. The usual force balance
assumes independent noise of the forces at the observed vertices, in units of $T$ (Ogita et al. 2022,
doi:10.1371/journal.pcbi.1010209). In the wings it depends on $g$ and the *pressure contrast*
$\kappa = (1 - s) / T$ alone.
Both are applied to each wing, to all together, and to synthetic wings with given parameters.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field, PositiveFloat

import vertax as vx
from experiments._shared import columns, fitted_noise
from experiments._wings import Wing, forces, padded, pinned, priors, response, synthetic
from vertax import bayes, plotting, runs

SYMBOLS = {"contrast": r"pressure contrast $\kappa$", "share": "perimeter share $g$", "noise": "noise"}
"""Quantities that both posteriors have."""


class Parameters(runs.Section):
    """Parameters of a wing."""

    tension: float = Field(default=0.1, gt=0)
    """T: mean tension of the edges."""
    share: float = 0.5
    """g: share of the tension that is proportional to perimeters."""
    targets: float = 0.5
    """s: share of the deviation of an observed area that the target area has."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    data: str = Field(default="wings", min_length=1)
    """Folder with vertex files of the Bayesian force inference (`*.dat`)."""
    wings: int | None = Field(default=None, ge=1)
    """Number of wings; by default all."""
    draws: int = Field(default=150, ge=20)
    """Draws of a chain of the forward model; 500 of the force balance."""
    warmup: int = Field(default=100, ge=20)
    """Steps of its adaptation; 500 of the force balance."""
    chains: int = Field(default=2, ge=2)
    """Chains of a posterior."""
    synthetic: Parameters = Parameters()
    """Parameters of the synthetic wings."""
    synthetic_noise: list[PositiveFloat] = Field(default=[0.003, 0.03], min_length=1)
    """Noise of their vertices, in cell sizes."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Difference of the two posteriors over its standard deviation, by quantity and data."""
    paths = sorted(Path(config.data).glob("*.dat"))[: config.wings]
    if not paths:
        raise ValueError(
            f"Key `data` must be a folder with files *.dat, but there are none in {config.data}."
        )
    wings = {path.stem: pinned(vx.io.read_force_inference(path).tissue) for path in paths}
    capacity = max(wing.tissue.n_cells for wing in wings.values())
    truth = {name: jnp.asarray(value) for name, value in config.synthetic.model_dump().items()}
    sets = {name: [padded(wing, capacity)] for name, wing in wings.items()}
    sets["all"] = [wing for (wing,) in sets.values()]
    first = next(iter(wings.values()))
    for number, noise in enumerate(config.synthetic_noise):
        sets[f"synthetic, noise {noise:g}"] = [padded(synthetic(first, truth, noise, number), capacity)]
    names = [(name, likelihood) for name in sets for likelihood in SAMPLERS]
    tasks = {f"{name}, {likelihood}": (sets[name], likelihood) for name, likelihood in names}
    parts = folder.map_parts(partial(draw, config), tasks, progress=progress, unit="posterior")
    rows = [
        {"data": name, "likelihood": likelihood} | summary(parts[f"{name}, {likelihood}"])
        for name, likelihood in names
    ]
    folder.save_table("posteriors", columns(rows))
    expected = {"contrast": float((1 - truth["targets"]) / truth["tension"]), "share": float(truth["share"])}
    folder.save_figure("posteriors", plot(rows, expected))
    score = lambda a, b, x: (a[x] - b[x]) / np.hypot(a[f"{x}_deviation"], b[f"{x}_deviation"])
    pairs = list(zip(rows[::2], rows[1::2], strict=True))
    return {
        f"{name}: difference / deviation": {a["data"]: float(score(a, b, name)) for a, b in pairs}
        for name in expected
    }


def forward(config: Config, wings: Sequence[Wing]) -> dict[str, np.ndarray]:
    """Draws of the posterior of the equilibrium, with noise of positions."""
    problems = []
    for tissue, model in wings:
        cost = float(jnp.sum(tissue.topology.alive_vertices)) * vx.costs.VertexDistance(tissue)
        start = model({name: jnp.asarray(value) for name, value in Parameters()})
        problems.append(vx.InverseProblem(tissue, start, cost, response=response()))
    problem, model = problems[0], wings[0].model
    if len(wings) > 1:
        problem = vx.fitting.stack(problems)
        model = jax.tree.map(lambda *x: jnp.stack(x), *(wing.model for wing in wings))
    density = bayes.LogPosterior(problem, priors(), fitted_noise, energy=model)
    options: Any = {"draws": config.draws, "warmup": config.warmup, "chains": config.chains}
    posterior = bayes.sample(density, config.seed, progress=False, **options)
    return {name: posterior.draws(name) for name in density.prior}


def force_balance(config: Config, wings: Sequence[Wing]) -> dict[str, np.ndarray]:
    """Draws of the posterior of the forces at the observed vertices, with independent noise."""
    import numpyro
    import numpyro.distributions as dist
    from numpyro.infer import MCMC, NUTS

    at = lambda *parameters: forces(wings, *map(float, parameters))
    area, observed = at(0, 0, 0), at(0, 0, 1)
    equal, perimeter = at(1, 0, 0) - area, at(1, 1, 0) - at(1, 0, 0)

    def model() -> None:
        contrast = numpyro.sample("contrast", dist.Normal(0.0, 10.0))
        # s/T; without effect where all areas are the observed ones, as in the wings.
        scaled_targets = numpyro.sample("scaled_targets", dist.Normal(0.0, 10.0))
        share = numpyro.sample("share", priors()["share"])
        noise = numpyro.sample("noise", priors()["noise"])
        balance = contrast * area + scaled_targets * observed + equal + share * perimeter
        numpyro.sample("forces", dist.Normal(balance, noise), obs=np.zeros(len(area)))  # pyright: ignore[reportArgumentType]

    chain = MCMC(
        NUTS(model),
        num_warmup=500,
        num_samples=500,
        num_chains=config.chains,
        chain_method="sequential",
        progress_bar=False,
    )
    chain.run(jax.random.key(config.seed))
    return {name: np.asarray(x) for name, x in chain.get_samples(group_by_chain=True).items()}


SAMPLERS = {"forward": forward, "force balance": force_balance}


def draw(config: Config, task: tuple[Sequence[Wing], str]) -> dict[str, np.ndarray]:
    """Draws of one of the posteriors."""
    wings, likelihood = task
    return SAMPLERS[likelihood](config, wings)


def summary(draws: dict[str, np.ndarray]) -> dict[str, Any]:
    """Means, standard deviations and R-hat."""
    import arviz

    if "targets" in draws:
        draws = draws | {"contrast": (1 - draws["targets"]) / draws["tension"]}
    row: dict[str, Any] = {}
    for name in (*SYMBOLS, "tension", "targets"):
        values = draws.get(name, np.full((2, 4), np.nan))  # the force balance has neither of the last two
        row |= {name: values.mean(), f"{name}_deviation": values.std()}
    row["r_hat"] = max(float(arviz.rhat(values)) for values in draws.values())
    return row


@plotting.house_style()
def plot(rows: list[dict[str, Any]], truth: dict[str, float]) -> Any:
    """Mean and standard deviation of each quantity, a line per data set."""
    figure, (axes,) = plotting.new_figure(1, len(SYMBOLS), width=2.2, height=3.2)
    names = list(dict.fromkeys(row["data"] for row in rows))
    for ax, (quantity, label) in zip(axes, SYMBOLS.items(), strict=True):
        for number, method in enumerate(dict.fromkeys(row["likelihood"] for row in rows)):
            chosen = [row for row in rows if row["likelihood"] == method]
            places = np.array([names.index(row["data"]) for row in chosen]) + 0.16 * (2 * number - 1)
            means, errors = (
                [row[quantity] for row in chosen],
                [row[f"{quantity}_deviation"] for row in chosen],
            )
            ax.errorbar(
                means, places, xerr=errors, fmt="o", ms=3, color=plotting.SERIES[number], label=method
            )
        if quantity in truth:
            n = sum(name.startswith("synthetic") for name in names)
            ax.plot([truth[quantity]] * 2, [len(names) - n - 0.5, len(names) - 0.5], color=plotting.INK, lw=1)
        ax.set(xlabel=label, yticks=range(len(names)), yticklabels=[], ylim=(len(names) - 0.5, -0.5))
    axes[0].set_yticklabels(names)
    axes[-1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure
