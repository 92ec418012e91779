"""The messages on the page of errors exist in the program, and numbers on pages are right."""

import ast
import functools
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from vertax.relax._feasibility import Feasibility
from vertax.relax._loop import Search
from vertax.solvers import NewtonCG, TruncatedCG, VertexTrustRegion

ROOT = Path(__file__).parents[2]
ANY = "…"  # any text, in a quotation and for the fields of an f-string
PAGE = (ROOT / "docs/errors.md").read_text(encoding="utf-8")
HEADINGS = re.findall(r'^\?\?\? failure "(.*)"$', PAGE, re.MULTILINE)
QUOTED = [message for heading in HEADINGS for message in heading.strip("“”").split("” and “")]


def templates(source: str) -> Iterator[str]:
    """The strings in a program, with … for the fields of f-strings."""
    tree = ast.parse(source)
    inside: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            inside.update(node.values)
            parts = [
                str(part.value) if isinstance(part, ast.Constant) else ANY for part in node.values
            ]
            yield "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in inside:
            yield node.value


@functools.cache
def sources() -> list[tuple[str, frozenset[str]]]:
    """All strings of vertax, Equinox and Optimistix; and the words of each."""
    folders = [ROOT / "vertax"]
    for name in ("equinox", "optimistix"):
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        folders.append(Path(spec.origin).parent)
    files = [file for folder in folders for file in folder.rglob("*.py")]
    texts = {
        " ".join(text.split())
        for file in files
        for text in templates(file.read_text(encoding="utf-8"))
    }
    return [(text, words(text)) for text in texts if 5 < len(text) < 1000]


def words(text: str) -> frozenset[str]:
    return frozenset(re.findall(r"[a-z_]{3,}", text.lower()))


def agreement(quoted: str, template: str) -> float:
    """Fraction of the letters of a quotation that match a template; 0 if it is not one of its messages.

    Both are patterns; … matches any text. Dynamic programming over the prefixes of both, as for the edit
    distance.
    """
    impossible = -1
    row = [0] + [impossible] * len(template)
    for j, letter in enumerate(template):
        row[j + 1] = row[j] if letter == ANY else impossible
    for character in quoted:
        above, row = row, [impossible] * (len(template) + 1)
        row[0] = above[0] if character == ANY else impossible
        for j, letter in enumerate(template):
            best = above[j] + 1 if character == letter != ANY and above[j] >= 0 else impossible
            if letter == ANY:
                best = max(best, row[j], above[j + 1], above[j])
            if character == ANY:
                best = max(best, above[j + 1], row[j], above[j])
            row[j + 1] = best
    letters = len(quoted) - quoted.count(ANY)
    return max(row[-1], 0) / letters


def best_agreement(quoted: str) -> float:
    """Agreement with the nearest message of the program, also with another string in one of its fields."""
    message = re.sub(r"^\w+Error: ", "", quoted)
    own_words = words(message)
    similarity = lambda each: len(own_words & each[1]) / (4 + len(own_words | each[1]))
    near = sorted(sources(), key=lambda each: -similarity(each))[:12]
    # A quotation may omit the end or the beginning of a message.
    endings = [message, message.removesuffix(f" {ANY}"), ANY + message]
    best = max(agreement(each, text) for each in endings for text, _ in near)
    if best > 0.6:
        return best
    frames = [text for text, _ in sources() if ANY in text and len(text) < 80]
    frame = max(agreement(each, text) for each in endings for text in frames)
    part = max(agreement(message, f"{ANY}{text}{ANY}") for text, _ in near)
    return frame + part if frame > 0 else 0


@pytest.mark.parametrize("quoted", QUOTED)
def test_quoted_messages_exist_in_the_program(quoted):
    assert best_agreement(quoted) > 0.6


@pytest.mark.parametrize(
    "quoted",
    [
        "The gradient by equilibrium propagation cannot be trusted: the moon is full. …",
        "Argument `mask` must hold integer numbers, but its dtype is float64. …",
        "Nothing of this kind is raised anywhere.",
    ],
)
def test_invented_messages_do_not_exist_in_the_program(quoted):
    assert best_agreement(quoted) < 0.6


def test_headings_keep_their_quotation_marks():
    # Markdown removes the outer ones and keeps others of the same kind.
    assert not [heading for heading in HEADINGS if '"' in heading]


def test_table_of_constants_is_that_of_the_code():
    owners: dict[str, object] = {
        owner.__name__: owner() for owner in (NewtonCG, TruncatedCG, VertexTrustRegion)
    }
    owners["relaxation"] = Feasibility(None)
    owners["search"] = Search  # defaults of a dataclass are attributes of the class
    table = (ROOT / "docs/solvers.md").read_text(encoding="utf-8").partition("| class | field |")[2]
    owner, compared = None, 0
    for row in table.partition("\n\n")[0].splitlines()[2:]:
        name, fields, values = (entry.strip() for entry in row.split("|")[1:4])
        owner = owners[name.strip("[`").partition("`")[0]] if name else owner
        for field, value in zip(fields.split(", "), values.split(", "), strict=True):
            assert getattr(owner, field.strip("`")) == float(value), field
            compared += 1
    assert compared >= 25


NUMBERS = [
    "zero",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
    "thirteen",
    "fourteen",
    "fifteen",
]
COUNTED = {
    "notebooks": len(list(ROOT.glob("notebooks/*.ipynb"))),
    "stories": len(list(ROOT.glob("notebooks/*.ipynb"))),
    "experiments": len(list(ROOT.glob("experiments/[a-z]*.py"))),
    "configurations": len(list(ROOT.glob("configs/*.toml"))),
}


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("docs/*.md"))],
    ids=lambda page: page.name,
)
def test_numbers_on_pages_are_right(page):
    text = page.read_text(encoding="utf-8").lower()
    stated = re.findall(rf"\b(\d+|{'|'.join(NUMBERS)}) (?:small )?({'|'.join(COUNTED)})\b", text)
    number = lambda word: NUMBERS.index(word) if word in NUMBERS else int(word)
    assert all(number(word) == COUNTED[what] for word, what in stated)
