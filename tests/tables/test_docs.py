"""docs/own-data.md is what a new user reads: its example runs;
docs/reference/schema.md is the schema.
"""

import re
import runpy
from html import unescape
from pathlib import Path

import pytest
from doors import knock

from gsparc.commands.check import main as check
from gsparc.data.fields import FIELDS

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "own-data.md").read_text(encoding="utf-8")
SCHEMA = (DOCS / "reference" / "schema.md").read_text(encoding="utf-8")


def test_the_site_shows_the_schema(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "site")  # as mkdocs does for its hooks
    pytest.importorskip("mkdocs", reason="the site's tables need the extra docs")
    hook = runpy.run_path(str(DOCS / "site" / "pages.py"))
    row = r"^\| `(\w+)`" + r" \| (.+?)" * 5 + r" \| (.*?) ?\|$"
    rows = re.findall(row, hook["on_page_markdown"](SCHEMA), re.M)
    assert [tuple(map(unescape, cells)) for cells in rows] == [
        (f.name, f.shape, f.unit, f.required, f.meaning, f.holds, f.also) for f in FIELDS.values()
    ]


def test_the_example_makes_a_good_file(tmp_path, monkeypatch):
    code = re.search(r"```python\n(.*?)```", PAGE, flags=re.DOTALL).group(1)
    assert len(code.strip().splitlines()) <= 10
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    said = knock(check, "check", ["mine.npz", "--no-draw"])
    assert said.status == 0, said
    for words in ("300 channels", "2.4 GHz", "mine.npz: good"):
        assert words in "\n".join(said.out)
