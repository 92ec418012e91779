"""Names and prose in plain technical English."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Pronouns, adverbs and verbs: a name is a noun, a function a verb.
FORBIDDEN_NAMES = frozenset(
    (
        *(
            "around",
            "besides",
            "found",
            "greater",
            "here",
            "known",
            "lesser",
            "no",
            "none",
            "nowhere",
        ),
        *("own", "said", "seen", "still", "there", "told", "verdict", "whole", "yes"),
    )
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
    if path != Path(__file__)
)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


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


@pytest.mark.parametrize("path", CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_code_uses_plain_names_and_words(path):
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    names = [f"line {line}: {name}" for name, line in names_of(tree) if name in FORBIDDEN_NAMES]
    prose = [
        f"line {line}: {match.group()}"
        for text, line in prose_of(source, tree)
        for match in FORBIDDEN_PROSE.finditer(text)
    ]
    assert not names, f"Name by nouns and verbs (docs/layout.md): {sorted(names)}"
    assert not prose, f"Write in standard terms: {prose}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_use_plain_words(path):
    text = path.read_text(encoding="utf-8")
    words = [match.group() for match in FORBIDDEN_PROSE.finditer(text)]
    assert not words
