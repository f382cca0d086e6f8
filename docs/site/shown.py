"""Files that pages show between marks, a CSV file as a table, others as code:
python docs/site/shown.py

A page holds `<!-- PATH: begin -->` and `<!-- PATH: end -->`, PATH from the root: a clone shows what
the site shows.
"""

from __future__ import annotations

import re
from pathlib import Path

from cells import table

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
MARKED = re.compile(
    r"^<!-- (?P<path>\S+\.\w+): begin -->\n.*?^<!-- (?P=path): end -->$", re.MULTILINE | re.DOTALL
)
LANGUAGES = {".py": " { .python }", ".toml": "toml"}  # of a fence


def shown(page: str) -> str:
    """Return a page with what its marked files hold now;
    KeyError of one that is neither table nor code.
    """
    return MARKED.sub(lambda found: _block(found["path"]), page)


def _block(path: str) -> str:
    file = ROOT / path
    if file.suffix == ".csv":
        text = table(file)
    else:
        text = f"```{LANGUAGES[file.suffix]}\n{file.read_text(encoding='utf-8').rstrip()}\n```"
    return f"<!-- {path}: begin -->\n\n{text}\n\n<!-- {path}: end -->"


if __name__ == "__main__":
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        page.write_text(shown(text), encoding="utf-8")
