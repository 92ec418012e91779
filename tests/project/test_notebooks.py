"""The notebooks are complete as they lie in the repository; `make notebooks` executes them."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def _cells(path: Path) -> list[dict]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def _outputs(path: Path) -> list[dict]:
    return [output for cell in _cells(path) for output in cell.get("outputs", [])]


def test_there_are_notebooks():
    assert len(NOTEBOOKS) == 11


@pytest.mark.parametrize("page", ["README.md", "docs/notebooks.md", "mkdocs.yml"])
def test_every_notebook_is_listed_and_no_other(page):
    listed = re.findall(r"notebooks/(\w+\.ipynb)", (ROOT / page).read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in NOTEBOOKS]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
class TestNotebook:
    def test_begins_with_the_number_of_its_file(self, path):
        title = "".join(_cells(path)[0]["source"]).splitlines()[0]
        number, _, name = path.stem.partition("_")
        assert title.lower() == f"# {number}. {name.replace('_', ' ')}"

    def test_was_executed_once_from_top_to_bottom(self, path):
        counts = [c["execution_count"] for c in _cells(path) if c["cell_type"] == "code"]
        assert counts == list(range(1, len(counts) + 1))

    def test_holds_pictures_and_numbers(self, path):
        outputs = _outputs(path)
        assert any("image/png" in output.get("data", {}) for output in outputs)
        assert any(output.get("name") == "stdout" for output in outputs)

    def test_holds_no_error_and_no_warning(self, path):
        kinds = {(output["output_type"], output.get("name")) for output in _outputs(path)}
        assert not {kind for kind in kinds if kind[0] == "error" or kind[1] == "stderr"}

    def test_knows_no_machine(self, path):
        text = [json.dumps(cell["source"]) for cell in _cells(path)]
        for output in _outputs(path):
            data = {k: v for k, v in output.get("data", {}).items() if k != "image/png"}
            text.append(json.dumps([data, output.get("text")]))
        found = re.findall(
            r"(?:/home|/Users|/tmp|/root|/usr|/opt|[A-Z]:\\\\)[\w/.-]*", "".join(text)
        )
        assert not found

    def test_is_small_and_free_of_volatile_metadata(self, path):
        assert path.stat().st_size < 400_000
        assert all(cell["metadata"] == {} for cell in _cells(path))

    def test_has_a_light_setting(self, path):
        assert any("VERTAX_LIGHT" in "".join(cell["source"]) for cell in _cells(path))
