"""Formulas as MathML, which browsers show by themselves: no script, and no network."""

import html
import re

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

# What `pymdownx.arithmatex` leaves of a formula: \(...\) in a line, \[...\] on its own.
MARKED = re.compile(r'<(span|div) class="arithmatex">(\\[(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
# In the text of a notebook formulas stand between dollar signs still, in code dollars are dollars.
CODE = re.compile(
    r"(<pre\b.*?</pre>|<code\b.*?</code>|<script\b.*?</script>|<style\b.*?</style>)", re.DOTALL
)
DOLLARS = re.compile(
    r"\$\$(?P<block>[^$]+)\$\$|(?<![\\\w])\$(?P<line>[^$\s](?:[^$]*[^$\s])?)\$(?!\w)"
)
# What the converter does not know.
INSTEAD = {r"\arg": r"\operatorname{arg}", r"\!": ""}
MATHJAX = re.compile(r"<!-- Load mathjax -->.*?<!-- End of mathjax configuration -->", re.DOTALL)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Write the formulas of a page as MathML.

    **Arguments:**

    - `content`: the page, in HTML.
    - `page`, `config`, `files`: what it is made from.

    **Returns:** the page.

    **Raises:** `PluginError` for a formula that cannot be converted, with the page and the formula.
    """
    where = page.file.src_uri
    content = MARKED.sub(lambda m: _mathml(m[3], m[2] == r"\[", where), content)
    if not where.endswith(".ipynb"):
        return content
    pieces = CODE.split(MATHJAX.sub("", content))
    pieces[::2] = [
        DOLLARS.sub(lambda m: _mathml(m["block"] or m["line"], bool(m["block"]), where), text)
        for text in pieces[::2]
    ]
    return "".join(pieces)


def _mathml(formula: str, block: bool, where: str) -> str:
    formula = html.unescape(re.sub(r"<[^>]*>", "", formula)).strip()
    for unknown, known in INSTEAD.items():
        formula = formula.replace(unknown, known)
    try:
        mathml = convert(formula, display="block" if block else "inline")
    except Exception as error:
        raise PluginError(
            f"{where}: the formula {formula} cannot be converted: {error!r}"
        ) from error
    if "\\" in html.unescape(mathml):
        raise PluginError(f"{where}: a command is unknown in the formula {formula}: {mathml}")
    return f'<div class="formula">{mathml}</div>' if block else mathml
