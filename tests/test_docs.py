"""The map shows every package, and the documents name files, commands and choices that exist."""

import csv
import json
import re
from collections import defaultdict
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import field_table
import pandas as pd
import pytest
from hydra import compose, initialize_config_module
from pages import FOLDERS, PAGES, PRESENT, ROOT, commands, said

from gsparc.commands.shared.cli import offer_scenes
from gsparc.models.registry import built_in_methods
from gsparc.simulate.scenes.shipped import list_shipped_scenes

MAP = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
SITE = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
# Their commands take long: read, not run
MEASURED = sorted((ROOT / "docs" / "results").glob("*.md"))
PER_PAGE = pytest.mark.parametrize(
    "page", [*PAGES, *MEASURED], ids=lambda page: f"{page.parent.name}/{page.name}"
)
TODAY = pytest.mark.parametrize(
    "page", [*PRESENT, *MEASURED], ids=lambda page: f"{page.parent.name}/{page.name}"
)
README_LINES = 100
GONE = (
    "vsgp",
    "directed",
    "model=bearings",
    "committee",
    "budget_s",
    "budget_clock",
    "trainer.val_every",
)


def test_a_tutorial_imported_a_name_that_was_gone():
    """Cells are run by the slow suite alone; what they import is looked up here."""
    cells = [
        "".join(cell["source"])
        for file in sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
        for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]
        if cell["cell_type"] == "code"
    ]
    lines = re.findall(
        r"^from (gsparc[\w.]*) import ([\w, ]+)$", "\n".join(cells), flags=re.MULTILINE
    )
    assert lines
    gone = [
        f"{home}.{n}" for home, names in lines for n in names.split(", ") if not can_import(home, n)
    ]
    assert not gone


def test_pages_show_their_files_as_they_are(monkeypatch):
    """`python docs/site/shown.py` writes tables and code between marks:
    a clone shows what the site shows.
    """
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")
    from shown import MARKED, PAGES, shown

    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    assert not [page.name for page, text in texts.items() if shown(text) != text]
    assert len(MARKED.findall("".join(texts.values()))) >= 5


def test_the_fields_table_is_its_csv():
    """`python tests/helpers/field_table.py` writes the tables."""
    page = field_table.PAGE.read_text(encoding="utf-8")
    measured = page.split(field_table.BEGIN)[1].split(field_table.END)[0]
    assert measured.strip() == field_table.text(field_table.collect([field_table.FILE])).strip()


def can_import(module: str, name: str) -> bool:
    return find_spec(module) is not None and (
        hasattr(import_module(module), name) or find_spec(f"{module}.{name}") is not None
    )


def test_every_package_is_on_the_map():
    named = set(re.findall(r"^\| `([\w./]+)`", MAP, flags=re.MULTILINE))
    packages = {f"gsparc/{file.parent.name}" for file in (ROOT / "gsparc").glob("*/__init__.py")}
    packages |= {f"{folder}/" for folder in ("conf", "callbacks", "ops", "bench", "tests")}
    assert not packages - named
    assert not {name for name in named if not (ROOT / name).exists()}
    groups = {folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()} - {
        "__pycache__"
    }
    assert not groups - set(re.findall(r"(\w+)/", MAP))


def test_the_walk_is_through_functions_that_are_there():
    """At most 12 steps of a spectrum and of a power, each a file and what it defines."""
    for walk in MAP.partition("## The walk")[2].partition("\n## ")[0].split("**A ")[1:]:
        steps = re.findall(r"(?:^|\s)(\d+)\.? `([\w/]+\.py) ([\w.]+)`", walk)
        assert len(steps) > 5 and int(steps[-1][0]) == 12
        for _, file, name in steps:
            text = (ROOT / "gsparc" / file).read_text(encoding="utf-8")
            assert all(re.search(rf"(?:def|class) {part}\b", text) for part in name.split(".")), (
                file,
                name,
            )


@PER_PAGE
def test_what_a_page_names_is_there(page):
    """Files that it links, names or shows, headings of other pages, and tests."""
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    files, anchors = (
        zip(*(link.partition("#")[::2] for link in links), strict=True) if links else ((), ())
    )
    missing = [file for file in files if not (page.parent / file).exists()]
    shown_tables = re.findall(r"<!-- table: (\S+) -->", text)
    missing += [path for path in shown_tables if not (ROOT / path).exists()]
    for path in shown_tables:  # a comma without quotes made five cells of four
        with (ROOT / path).open(encoding="utf-8", newline="") as file:
            heads, *rows = csv.reader(file)
        missing += [f"{path}: {row[0]}" for row in rows if len(row) != len(heads)]
    rooms = r"(?:gsparc|ops|callbacks|conf|bench|tests|docs)"
    paths = re.findall(rf"`({rooms}/[\w./-]+(?:\.\w+|/))`", text)
    missing += [path for path in paths if "NAME" not in path and not (ROOT / path).exists()]
    for file, anchor in zip(files, anchors, strict=True):
        if anchor and anchor not in headings(page.parent / file if file else page):
            missing.append(f"{file}#{anchor}")
    for file, name in re.findall(r"`([\w/]*test_\w+\.py)::(\w+)`", text):
        found = [
            path
            for path in (ROOT / "tests").rglob(Path(file).name)
            if path.as_posix().endswith(file)
        ]
        if not any(f"def {name}(" in path.read_text(encoding="utf-8") for path in found):
            missing.append(f"{file}::{name}")
    assert not missing


@cache
def headings(page: Path) -> set[str]:
    """As links name them; none of a page that is not there."""
    if not page.exists():
        return set()
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.slow
def test_commands_compose():
    """Commands, settings and choices that the documents name exist."""
    given, alike = commands(), defaultdict(dict)
    assert len(given) > 30
    # Those of the same choices at once: they differ in settings alone
    for name, *overrides in given:
        chosen = {
            word
            for word in overrides
            if word[0] in "~+" or (ROOT / "conf" / word.split("=")[0]).is_dir()
        }
        alike[name, frozenset(chosen)] |= dict.fromkeys(overrides)
    offer_scenes()
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        for (name, _), overrides in alike.items():
            if (
                "search=optuna" in overrides
                and find_spec("hydra_plugins.hydra_optuna_sweeper") is None
            ):
                continue  # an extra that is not installed here
            assert compose(name, list(overrides)), (name, *overrides)


@TODAY
def test_choices_and_names_are_of_today(page):
    """And whoever installed a wheel is not stopped at a file of the clone:
    most pages said `train.py`.
    """
    code = "\n".join(said(page))
    for group in ("model", "dataset", "split", "trainer", "callbacks", "experiment", "scene"):
        chosen = re.findall(rf"(?<![\w.]){group}=([a-z][\w/]*)", code)
        offered = ("help", *list_shipped_scenes()) if group == "scene" else ()
        written = [name for name in chosen if name not in offered]
        assert not [
            name for name in written if not (ROOT / "conf" / group / f"{name}.yaml").exists()
        ], group
    assert not [name for name in GONE if re.search(rf"(?<![\w.]){re.escape(name)}\b", code)]
    assert "gsparc.commands" not in code, "name the command"
    if page.parent.name == "docs":
        assert not re.search(r"python train\.py (?!\.\.\.)", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("folder", [*FOLDERS, "docs/results"])
def test_the_site_has_every_page(folder):
    files = [f for kind in ("md", "ipynb") for f in (ROOT / folder).glob(f"*.{kind}")]
    assert not [f.name for f in files if str(f.relative_to(ROOT / "docs")) not in SITE]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_every_method_is_listed():
    """Each name of the registry is a row or an entry of the page of methods,
    or of the page of training.
    """
    text = "".join(
        (ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("peers.md", "train.md")
    )
    assert not {name for name in built_in_methods() if f"`{name}`" not in text}


def test_every_regression_test_of_the_hard_cases_is_there():
    """`docs/results/hard-cases-bugs.csv` names them;
    nothing on it may be lost when tests are renamed.
    """
    table = pd.read_csv(ROOT / "docs" / "results" / "hard-cases-bugs.csv", keep_default_na=False)
    named = [name.partition("::") for names in table["regression test"] for name in names.split()]
    assert len(named) > 150
    for file, _, test in named:
        text = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"def {test}\(", text) if test else "def test_" in text, f"{file}::{test}"
