"""The map shows every package, and the documents name files, commands and choices that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gsparc.methods.registry import METHODS
from gsparc.studies.commands import COMMANDS

ROOT = Path(__file__).parents[1]
MAP = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
TOP = [ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG")]
PAGES = [*TOP, *sorted((ROOT / "docs").glob("*.md"))]
PRESENT = [page for page in PAGES if page.stem != "CHANGELOG"]  # which also speaks of names that are gone
PER_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
TODAY = pytest.mark.parametrize("page", PRESENT, ids=lambda page: page.name)
README_LINES = 150
GONE = ("vsgp", "directed", "bearings", "committee", "trainer.budget_s", "trainer.val_every")


def test_every_package_is_on_the_map():
    named = set(re.findall(r"^\| `([\w./]+)`", MAP, flags=re.MULTILINE))
    packages = {f"gsparc/{file.parent.name}" for file in (ROOT / "gsparc").glob("*/__init__.py")}
    packages |= {f"{folder}/" for folder in ("conf", "callbacks", "ops", "bench", "tests")}
    assert not packages - named
    assert not {name for name in named if not (ROOT / name).exists()}
    groups = {folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()} - {"__pycache__"}
    assert not groups - set(re.findall(r"(\w+)/", MAP))


@PER_PAGE
def test_links_and_paths_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    rooms = r"(?:gsparc|ops|callbacks|conf|bench|tests|docs)"
    paths = re.findall(rf"`({rooms}/[\w./-]+(?:\.\w+|/))`", text)
    missing += [path for path in paths if "NAME" not in path and not (ROOT / path).exists()]
    assert not missing


@PER_PAGE
def test_tests_that_are_named_exist(page):
    for file, name in re.findall(r"`([\w/]*test_\w+\.py)::(\w+)`", page.read_text(encoding="utf-8")):
        found = [path for path in (ROOT / "tests").rglob(Path(file).name) if path.as_posix().endswith(file)]
        assert any(f"def {name}(" in path.read_text(encoding="utf-8") for path in found), f"{file}::{name}"


@PER_PAGE
def test_headings_that_are_linked_exist(page):
    def anchors(path: Path) -> set[str]:
        titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}

    for link, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" not in link:
            assert anchor in anchors(page.parent / link if link else page), f"{link}#{anchor}"


@TODAY
def test_commands_are_there(page):
    text = page.read_text(encoding="utf-8")
    code = re.findall(r"```\n.*?```|`[^`\n]+`", text, flags=re.DOTALL)
    said = re.findall(r"(?:^|[`\s])(?:python -m )?gsparc ([a-z]+)", "\n".join(code), flags=re.MULTILINE)
    assert not set(said) - COMMANDS.keys()
    assert not re.search(r"python -m gsparc\.|gsparc\.studies", text), "say `gsparc COMMAND`"


@TODAY
def test_models_and_datasets_are_there(page):
    text = page.read_text(encoding="utf-8")
    for group, word in (("model", r"\bmodel"), ("dataset", r"\bdataset"), ("experiment", r"\bexperiment")):
        chosen = {name for found in re.findall(rf"{word}=([\w,/]+)", text) for name in found.split(",")}
        files = [ROOT / "conf" / group / f"{name}.yaml" for name in chosen if name.islower()]
        assert not [file.name for file in files if not file.exists()]


@TODAY
def test_names_that_are_gone_are_not_used(page):
    code = re.findall(r"```\n.*?```|`[^`\n]+`", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not [name for name in GONE if re.search(rf"(?<![\w.]){re.escape(name)}\b", "\n".join(code))]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_every_method_is_listed():
    """Each name of the registry is a row or an entry of the page of methods, or of the page of commands."""
    text = "".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("peers.md", "commands.md"))
    assert not {name for name in METHODS if f"`{name}`" not in text}
