"""The map shows every room, and the documents name files that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAP = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_every_module_and_folder_is_on_the_map():
    """Half of the modules were not: whoever looks for one finds its row and its reason."""
    rows = [line.split("|")[1] for line in MAP.splitlines() if line.startswith("| `")]
    named = set(re.findall(r"[\w.]+", " ".join(rows)))
    modules = {file.stem for file in (ROOT / "gsparc").glob("*.py")} - {"__init__"}
    folders = {file.parent.name for file in (ROOT / "gsparc").glob("*/__init__.py")}
    assert not (modules | folders) - named
    groups = {folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()} - {"__pycache__"}
    assert not groups - set(re.findall(r"(\w+)/", MAP))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_paths_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    rooms = r"(?:gsparc|ops|callbacks|conf|bench|tests|docs)"
    paths = re.findall(rf"`({rooms}/[\w./-]+\.\w+)`", text)
    missing += [path for path in paths if not (ROOT / path).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_there(page):
    modules = set(re.findall(r"python -m gsparc\.([a-z_]+)", page.read_text(encoding="utf-8")))
    here = ROOT / "gsparc"
    assert all((here / f"{m}.py").exists() or (here / m / "__main__.py").exists() for m in modules)
