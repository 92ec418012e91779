"""The notebooks, which lie beside the documentation, as pages of it."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page


@event_priority(100)  # before the plugin that turns notebooks into pages
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add every notebook of the repository.

    **Arguments:**

    - `files`: the files of the documentation.
    - `config`: the configuration.

    **Returns:** these files and the notebooks.
    """
    root = Path(config.docs_dir).parent
    for path in sorted(root.glob("notebooks/*.ipynb")):
        name = path.relative_to(root).as_posix()
        files.append(File(name, str(root), config.site_dir, config.use_directory_urls))
    return files


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Let links from one notebook to another lead to its page.

    **Arguments:**

    - `output`: the page, in HTML.
    - `page`, `config`: what it is made from.

    **Returns:** the page.
    """
    if not page.file.src_uri.endswith(".ipynb"):
        return output
    return re.sub(r'href="(\w+)\.ipynb"', r'href="\1.html"', output)
