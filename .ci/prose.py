"""Check names, prose, quoted messages and numbers: `python .ci/prose.py`. A part of `make lint`."""

import ast
import functools
import importlib.util
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Pronouns, adverbs and verbs: a name is a noun, a function a verb.
FORBIDDEN_NAMES = re.compile(
    r"around|besides|found|here|known|lesser|greater|none|no|nowhere|own|said|seen|still|there|told|verdict|"
    r"whole|yes"
)
FORBIDDEN_PROSE = re.compile(
    r"\b(besides|blamed?|goes? along|knows?|lest|of (its|one's|their) own|so many|so much|tells?|told|"
    r"two minds|who|whom|whose)\b",
    re.IGNORECASE,
)
CODE = sorted(
    path
    for folder in ("vertax", "tests", "benchmarks", "experiments", "notebooks")
    for path in (ROOT / folder).rglob("*.py")
)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
# The messages on the page of errors; `…` is any text, in a quotation and for the fields of an f-string.
ANY = "…"
HEADINGS = re.findall(
    r'^\?\?\? failure "(.*)"$', (ROOT / "docs/errors.md").read_text("utf-8"), re.MULTILINE
)
QUOTED = [message for heading in HEADINGS for message in heading.strip("“”").split("” and “")]
INVENTED = [
    "The gradient by equilibrium propagation cannot be trusted: the moon is full. …",
    "Argument `mask` must hold integer numbers, but its dtype is float64. …",
    "Nothing of this kind is raised anywhere.",
]
LEAST_AGREEMENT = 0.6
NUMBERS = ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]
NUMBERS += ["eleven", "twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen"]
COUNTED = {
    "notebooks": len(list(ROOT.glob("notebooks/*.ipynb"))),
    "stories": len(list(ROOT.glob("notebooks/*.ipynb"))),
    "experiments": len(list(ROOT.glob("experiments/[a-z]*.py"))),
    "configurations": len(list(ROOT.glob("configs/*.toml"))),
}


def names_of(tree: ast.AST) -> set[tuple[str, int]]:
    """The names that a module defines, each with its line."""
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                names.add((name, node.lineno))
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add((name, node.lineno))
    return names


def prose_of(source: str, tree: ast.AST) -> list[tuple[str, int]]:
    """The comments and docstrings of a module, each with its line."""
    prose = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            prose.append((token.string, token.start[0]))
    for node in ast.walk(tree):
        # Docstrings of modules, classes, functions and fields.
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                prose.append((text, node.lineno))
    return prose


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
    """The words of a text."""
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
    its_words = words(message)
    similarity = lambda each: len(its_words & each[1]) / (4 + len(its_words | each[1]))
    near = sorted(sources(), key=lambda each: -similarity(each))[:12]
    # A quotation may omit the end or the beginning of a message.
    endings = [message, message.removesuffix(f" {ANY}"), ANY + message]
    best = max(agreement(each, text) for each in endings for text, _ in near)
    if best > LEAST_AGREEMENT:
        return best
    frames = [text for text, _ in sources() if ANY in text and len(text) < 80]
    frame = max(agreement(each, text) for each in endings for text in frames)
    part = max(agreement(message, f"{ANY}{text}{ANY}") for text, _ in near)
    return frame + part if frame > 0 else 0


def faults() -> Iterator[str]:
    """What is wrong, and where."""
    for path in CODE:
        source, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT)
        tree = ast.parse(source)
        for word, line in sorted(names_of(tree)):
            if FORBIDDEN_NAMES.fullmatch(word):
                yield f"{name}:{line}: name `{word}`; names are nouns, functions verbs (docs/layout.md)"
        for text, line in prose_of(source, tree):
            for word in FORBIDDEN_PROSE.finditer(text):
                yield f"{name}:{line}: `{word.group()}` is no standard term"
    for path in PAGES:
        text, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT)
        for word in FORBIDDEN_PROSE.finditer(text):
            yield f"{name}: `{word.group()}` is no standard term"
        if path.parent not in (ROOT, ROOT / "docs"):
            continue
        pattern = rf"\b(\d+|{'|'.join(NUMBERS)}) (?:small )?({'|'.join(COUNTED)})\b"
        for word, what in re.findall(pattern, text.lower()):
            number = NUMBERS.index(word) if word in NUMBERS else int(word)
            if number != COUNTED[what]:
                yield f"{name}: {word} {what}, but there are {COUNTED[what]}"
    for (
        heading
    ) in HEADINGS:  # Markdown removes the outer quotation marks and keeps others of the kind
        if '"' in heading:
            yield f'docs/errors.md: write “” for "" in {heading}'
    for message in QUOTED:
        if best_agreement(message) <= LEAST_AGREEMENT:
            yield f"docs/errors.md: the program has no message like {message}"
    for message in INVENTED:
        if best_agreement(message) > LEAST_AGREEMENT:
            yield f".ci/prose.py: an invented message agrees with one of the program: {message}"


if __name__ == "__main__":
    list_of_faults = list(faults())
    print(*list_of_faults, sep="\n", end="\n" * bool(list_of_faults))
    sys.exit(bool(list_of_faults))
