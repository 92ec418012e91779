"""The notebooks in the repository contain their outputs; `make notebooks` executes them."""

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


def test_number_of_notebooks():
    assert len(NOTEBOOKS) == 15


@pytest.mark.parametrize("page", ["README.md", "docs/notebooks.md", "mkdocs.yml"])
def test_pages_list_all_notebooks(page):
    listed = re.findall(r"notebooks/(\w+\.ipynb)", (ROOT / page).read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in NOTEBOOKS]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
class TestNotebook:
    def test_title_agrees_with_the_file_name(self, path):
        title = "".join(_cells(path)[0]["source"]).splitlines()[0]
        number, _, name = path.stem.partition("_")
        assert title.lower() == f"# {number}. {name.replace('_', ' ')}"

    def test_cells_were_executed_in_order(self, path):
        counts = [c["execution_count"] for c in _cells(path) if c["cell_type"] == "code"]
        assert counts == list(range(1, len(counts) + 1))

    def test_outputs_contain_images_and_text(self, path):
        outputs = _outputs(path)
        assert any("image/png" in output.get("data", {}) for output in outputs)
        assert any(output.get("name") == "stdout" for output in outputs)

    def test_outputs_contain_no_errors_or_warnings(self, path):
        kinds = {(output["output_type"], output.get("name")) for output in _outputs(path)}
        assert not {kind for kind in kinds if kind[0] == "error" or kind[1] == "stderr"}

    def test_contains_no_paths_of_a_machine(self, path):
        text = [json.dumps(cell["source"]) for cell in _cells(path)]
        for output in _outputs(path):
            data = {k: v for k, v in output.get("data", {}).items() if k != "image/png"}
            text.append(json.dumps([data, output.get("text")]))
        paths = re.findall(
            r"(?:/home|/Users|/tmp|/root|/usr|/opt|[A-Z]:\\\\)[\w/.-]*", "".join(text)
        )
        assert not paths

    def test_is_small_and_has_no_metadata(self, path):
        assert path.stat().st_size < 400_000
        assert all(cell["metadata"] == {} for cell in _cells(path))

    def test_has_a_light_setting(self, path):
        assert any("VERTAX_LIGHT" in "".join(cell["source"]) for cell in _cells(path))
