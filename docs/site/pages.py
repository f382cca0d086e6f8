"""What the site takes from elsewhere: pages beside the README,
and notebooks as they were executed.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import settings
from cells import table
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
EXECUTED = ROOT / "build" / "executed"
TABLE = re.compile(r"^<!-- table: (\S+\.csv) -->$", re.MULTILINE)  # its path from the root
SETTINGS = "<!-- settings -->"
SORT = ROOT / "gsparc" / "pictures" / "report" / "sort.js"  # tables are sorted as in reports
TAKEN = ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of `TAKEN`; show executed notebooks where there are."""
    for file in files:
        if file.src_uri.endswith(".ipynb") and (EXECUTED / file.src_uri).exists():
            file.src_dir = str(EXECUTED)
    for name in TAKEN:
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, name, content=text))
    files.append(File.generated(config, "site/sort.js", content=SORT.read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, **unused: Any) -> str:
    """Links to the README lead to the start page, those to taken pages to these;
    tables are shown.
    """
    markdown = TABLE.sub(lambda found: table(ROOT / found[1]), markdown)
    if SETTINGS in markdown:
        markdown = markdown.replace(SETTINGS, settings.list_files())
    markdown = re.sub(r"\]\((?:\.\./)+README\.md(#[\w-]*)?\)", "](index.md)", markdown)
    return re.sub(r"\]\(\.\./(ARCHITECTURE|CONTRIBUTING|CHANGELOG)\.md", r"](\1.md", markdown)


def on_env(env: Any, config: Any, **unused: Any) -> Any:
    """Names by which nobody should import, of modules that only use them, leave the inventory."""
    inventory = config.plugins["mkdocstrings"].handlers.inventory
    for path in [item.name for item in inventory.values() if item.role in ("class", "function")]:
        module, _, name = path.rpartition(".")
        room = import_module(module)
        if getattr(room, name).__module__ != module and name not in getattr(room, "__all__", ()):
            del inventory[path]
    return env


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Links of notebooks lead to pages; the theme's search takes its script from here,
    not from a network.
    """
    if page.file.src_uri.endswith(".ipynb"):
        output = re.sub(r'href="(?!\w+:)([^"#]+)\.md(#[^"]*)?"', r'href="\1.html\2"', output)
        name = page.file.src_uri.rpartition("/")[2]
        output = output.replace(
            "</h1>", f'</h1><p><a href="{name}" download>Download this notebook</a></p>', 1
        )
    up = "../" * page.url.count("/")
    return output.replace("https://unpkg.com/iframe-worker/shim", f"{up}site/frame-worker.js")
