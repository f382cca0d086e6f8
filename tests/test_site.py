"""The documentation site: tutorials run, the build is strict, links lead somewhere,
nothing is fetched.
"""

import csv
import os
import re
import subprocess
import sys
import time
import zlib
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote

import pytest
from filelock import FileLock

import gsparc

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "NO_MKDOCS_2_WARNING": "1"}
RUN = {"cwd": ROOT, "env": ENVIRONMENT, "capture_output": True, "text": True}


class Links(HTMLParser):
    """Addresses that a page leads to, and those that it fetches to be shown."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.leads: list[str] = []
        self.fetches: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        if tag == "a" and found.get("href"):
            self.leads.append(found["href"])
        shown = tag == "link" and found.get("rel") in ("stylesheet", "icon", "preload")
        self.fetches += [
            found[key]
            for key in ("src", "href")
            if found.get(key) and (tag != "a") and (key == "src" or shown)
        ]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages, built strictly; once for all processes."""
    folder = tmp_path_factory.getbasetemp() / "site"
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = tmp_path_factory.getbasetemp().parent / "site"
    with FileLock(f"{folder}.lock"):
        if not (folder / "index.html").exists():
            _build(folder)
    return folder


def _build(folder: Path) -> None:
    for needed in ("mkdocs", "mkdocs_jupyter", "mkdocstrings", "material", "nbclient", "ipykernel"):
        pytest.importorskip(needed, reason="the site needs the extra docs: make docs")
    subprocess.run(["make", "named"], check=True, **RUN)
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)], **RUN
    )
    assert done.returncode == 0, done.stdout + done.stderr


class Cells(HTMLParser):
    """Texts of all rows of tables."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data):
        if self.rows and self.rows[-1] and data != "\n":
            self.rows[-1][-1] += data


@pytest.fixture
def helpers(monkeypatch):
    """Makes `cells` and `settings` of docs/site importable."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")


TABLES = {
    path: page.relative_to(ROOT)
    for page in (ROOT / "docs").rglob("*.md")
    for path in re.findall(r"<!-- table: (\S+) -->", page.read_text(encoding="utf-8"))
}


@pytest.mark.parametrize("path", TABLES)
def test_no_cell_of_a_table_is_cut(helpers, path):
    """`mean |e|²` was three cells, of which the site showed "mean" and "e"."""
    from cells import table

    markdown = pytest.importorskip(
        "markdown", reason="the site needs the extra docs: make docs"
    ).markdown
    with (ROOT / path).open(encoding="utf-8", newline="") as file:
        written = [[text.replace("`", "").strip() for text in row] for row in csv.reader(file)]
    assert Cells(markdown(table(ROOT / path), extensions=["tables"])).rows == written


def test_every_setting_is_on_the_site(helpers):
    """Some were in no page; what files leave to their class is there with its meaning."""
    from settings import CONF, list_files, list_settings

    found = {
        file.relative_to(CONF).as_posix(): list_settings(file) for file in CONF.rglob("*.yaml")
    }
    assert not [(file, row) for file, rows in found.items() for row in rows if not row[2]]
    names = {file: {name: default for name, default, _ in rows} for file, rows in found.items()}
    assert names["paper/gsparc.yaml"]["model.attenuation.learn_gain"] == "false"
    assert names["model/gsparc.yaml"]["model.attenuation.learn_gain"] == "true"
    assert names["model/newrf.yaml"]["model.octaves"] == "8"
    assert names["scene/conference_room.yaml"]["scene.height_m"] == "[1.1, 1.5]"
    assert {"dataset.level_steps", "dataset.hall"} <= names["dataset/ble.yaml"].keys()
    assert {"trainer.overfit_batches", "trainer.max_steps"} <= names["trainer/cpu.yaml"].keys()
    assert names["map.yaml"]["promise.share"] == "0.9"
    text = list_files()
    assert all(f"| `{name}` |" in text for settings in names.values() for name in settings)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_names_are_those_that_users_import(site):
    """`SphereGrid` also stood under `gsparc.ops.native`, and `gsparc.fit` nowhere."""
    lines = (
        zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4])
        .decode()
        .splitlines()
    )
    names = {line.split()[0] for line in lines if line.split()[1] in ("py:class", "py:function")}
    assert {f"gsparc.{name}" for name in gsparc.__all__} <= names
    for module, _, name in (name.rpartition(".") for name in names):
        room = import_module(module)
        assert name in getattr(room, "__all__", ()) or getattr(room, name).__module__ == module, (
            module
        )


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_tutorials_run():
    pytest.importorskip("nbclient", reason="tutorials need the extra docs: make docs")
    # Which limits each cell
    done = subprocess.run([sys.executable, "docs/site/notebooks.py"], **RUN)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 notebooks: " in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_links_lead_somewhere_and_nothing_is_fetched(site):
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    assert len(pages) > 30 and "rasterize" in (site / "search" / "search_index.js").read_text()
    for page in pages:
        links = Links(page)
        assert not [a for a in links.fetches if re.match(r"(https?:)?//", a)], page
        assert "unpkg.com" not in page.read_text(), "the theme's search fetches a script"
        for address in {*links.leads, *links.fetches}:
            path = unquote(address.partition("#")[0].partition("?")[0])
            if path and not re.match(r"[a-z]+:", path):
                assert (page.parent / path).exists(), f"{page.relative_to(site)}: {address}"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", ["index.html", "reference/rasterizer.html"])
def test_pages_are_searched_from_a_folder(site, browser, page):
    browser.get((site / page).as_uri())
    entry = browser.find_element("css selector", "input.md-search__input")
    browser.execute_script("arguments[0].focus()", entry)
    entry.send_keys("rasterize")
    until, found = time.monotonic() + 30, ""
    while "Rasterizer" not in found:  # items stand in the page before they are shown
        assert time.monotonic() < until, [
            found,
            *(line["message"] for line in browser.get_log("browser")),
        ]
        time.sleep(0.2)
        found = browser.find_element("css selector", ".md-search-result__list").text
