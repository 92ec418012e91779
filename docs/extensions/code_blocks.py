"""Run the Python code of a page of the documentation: `python docs/extensions/code_blocks.py PAGE FOLDER`.

The blocks marked as `python` of a page run from top to bottom, in one namespace, and contain their imports. A
block with a last line `# raises NAME` must raise that exception. Pictures that the code saves are written to
the folder: `python docs/extensions/code_blocks.py docs/gallery.md docs/images` makes those of the gallery.
"""

import argparse
import contextlib
import os
import re
import textwrap
import time
from pathlib import Path
from typing import Any

BLOCK = re.compile(r"^([ ]*)```python\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
RAISES = re.compile(r"^# raises ([\w.]+)\s*\Z", re.MULTILINE)


def blocks(page: Path) -> list[tuple[int, str]]:
    """The Python blocks of a page, each with the number of lines above it."""
    text = page.read_text(encoding="utf-8")
    return [(text[: m.start(2)].count("\n"), textwrap.dedent(m[2])) for m in BLOCK.finditer(text)]


def run(page: Path, *, verbose: bool = False) -> dict[str, Any]:
    """Run the blocks of a page in the current folder.

    **Arguments:**

    - `page`: the page.
    - `verbose`: print the seconds of each block.

    **Returns:** the namespace after the last block.

    **Raises:**

    - `AssertionError` if a block does not raise the exception of its last line.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    for line, source in blocks(page):
        began = time.perf_counter()
        # Empty lines first, so that a traceback shows the line number of the page.
        code = compile("\n" * line + source, str(page), "exec")
        if raises := RAISES.search(source):
            expected = eval(raises[1], names)
            with contextlib.suppress(expected):
                exec(code, names)
                raise AssertionError(f"{page}, line {line}: the block does not raise {expected}")
        else:
            exec(code, names)
        if verbose:
            print(f"{page.name}, line {line}: {time.perf_counter() - began:.1f} s", flush=True)
    return names


def main() -> None:
    """Run one page in a folder."""
    parser = argparse.ArgumentParser(description="Run the Python code of a page.")
    parser.add_argument("page", type=Path)
    parser.add_argument("folder", type=Path, help="where the code writes its files")
    options = parser.parse_args()
    page = options.page.resolve()
    os.environ.setdefault("MPLBACKEND", "agg")
    os.chdir(options.folder)
    run(page, verbose=True)


if __name__ == "__main__":
    main()
