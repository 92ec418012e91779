"""The examples of the README run as they stand there."""

import re
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float

README = Path(__file__).parents[2] / "README.md"


@pytest.mark.slow
def test_the_examples_of_the_readme_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # they write files
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    # A reader who writes an energy of her own imports these; `Float` is the only thing left unsaid.
    names = {"eqx": eqx, "Array": Array, "Float": Float}
    exec("\n".join(blocks), names)
    assert names["fit"].history.relative_error[-1] < 1e-5
    assert jnp.all(jnp.isfinite(names["gradient"].terms[1].strength))
