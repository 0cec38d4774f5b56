"""
Write the tables into the pages, computed from the rows of ``examples/benchmarks/results``.

    python docs/_ext/fill_tables.py

Each stands between ``<!-- name -->`` and ``<!-- end -->``, where the name is a function of ``tables.py`` or
``tuning.py``.
"""

import re
from pathlib import Path

import tables
import tuning

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MARKED = re.compile(r"<!-- (\w+) -->.*?<!-- end -->", re.DOTALL)


def filled(text: str) -> str:
    """The text of a page with its tables computed."""
    return MARKED.sub(lambda found: f"<!-- {found[1]} -->{computed(found[1])}<!-- end -->", text)


def computed(name: str) -> str:
    """A table, with empty lines around it, or a figure of a sentence."""
    text = getattr(tuning if name in ("chosen_on", "settings") else tables, name)()
    return f"\n\n{text}\n\n" if text.startswith("|") else text


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
