"""The tutorial's pages: the scripts of ``examples/`` in jupytext's percent format."""

import re
from pathlib import Path

import jupytext
from nbformat import NotebookNode
from sphinx.application import Sphinx


def copy_pages(source: Path, target: Path) -> None:
    """Copy the scripts that are pages, unless they are there already, and remove the pages of scripts that are gone."""
    target.mkdir(exist_ok=True)
    pages = {}
    for path in source.glob("[0-9]*.py"):
        # With two digits, the order of the names is the order of the tutorial
        number, _, name = path.name.partition("_")
        page = f"{int(number):02}_{name}"
        pages[page] = path.read_text(encoding="utf-8") + links(page, path.name)
    for name, text in pages.items():
        if not (target / name).exists() or (target / name).read_text(encoding="utf-8") != text:
            (target / name).write_text(text, encoding="utf-8")
    for path in target.glob("*.py"):
        if path.name not in pages:
            path.unlink()


def link_pages(app: Sphinx, page: str, content: list[str]) -> None:
    """In the site, links to the scripts lead to their pages."""
    content[0] = re.sub(
        r"\]\(\.\./examples/(\d+)_(\w+\.py)\)", lambda found: f"](lesson/{int(found[1]):02}_{found[2]})", content[0]
    )


def links(page: str, script: str) -> str:
    """A last cell with the page as a notebook and as the script that it is."""
    notebook = Path(page).with_suffix(".ipynb")
    return (
        "\n# %% [markdown]\n"
        f"# ---\n# Download this page as a {{nb-download}}`Jupyter notebook <{notebook}>`, or run it as a script:\n"
        f"# `python examples/{script}`\n"
    )


def read(text: str) -> NotebookNode:
    """A page as a notebook that says in which language it is, also where it is not executed."""
    notebook = jupytext.reads(text, fmt="py:percent")
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "ipython3"}
    return notebook
