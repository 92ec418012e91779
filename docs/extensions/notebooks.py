"""The notebooks, which lie beside the documentation, as pages of it."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files


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
