"""A page that would fetch something from elsewhere is an error: the site is read without a network."""

import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.pages import Page

FETCHED = re.compile(
    r'<(?:script|img|iframe|source|video)\b[^>]*\bsrc="(?:https?:)?//[^"]*"'
    r'|<link\b(?=[^>]*\brel="(?:stylesheet|preload|preconnect|icon)")[^>]*\bhref="(?:https?:)?//[^"]*"'
)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Look at a page as it will be written.

    **Arguments:**

    - `output`: the page, in HTML.
    - `page`, `config`: what it is made from.

    **Returns:** the page.

    **Raises:** `PluginError` for scripts, style sheets and pictures from elsewhere.
    """
    found = sorted(set(FETCHED.findall(output)))
    if found:
        raise PluginError(f"{page.file.src_uri} is not to be read without a network: {found}")
    return output
