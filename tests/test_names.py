"""Every name that a reader meets is explained: settings, columns, keys, methods."""

import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from campaigns import compose, powers
from names import find_unexplained
from pages import ROOT

import gsparc
from gsparc.commands.train import train

CONF = sorted((ROOT / "conf").rglob("*.yaml"))
HYDRAS = {"hydra", "defaults", "_target_", "name"}
ENTRIES = {"datasets", "splits", "methods"}  # of comparisons: their heads say what they hold


def _leaves(node: yaml.MappingNode) -> Iterator[int]:
    """Lines of settings, from 0."""
    for key, value in node.value:
        block = isinstance(value, yaml.MappingNode) and not value.flow_style
        if key.value in HYDRAS | ENTRIES:
            continue
        yield from _leaves(value) if block else [key.start_mark.line]


@pytest.mark.parametrize("file", CONF, ids=lambda file: str(file.relative_to(ROOT / "conf")))
def test_every_setting_has_a_comment(file: Path):
    """Beside it or in the line above; 456 of them had none, `batch` of `gsparc link` among them."""
    text = file.read_text(encoding="utf-8")
    lines, node = text.splitlines(), yaml.compose(text)
    found = _leaves(node) if isinstance(node, yaml.MappingNode) else []
    said = [i for i in found if "# " not in lines[i] and not lines[i - 1].lstrip().startswith("# ")]
    assert not [lines[i].strip() for i in said]


def test_a_run_writes_no_name_that_no_table_explains(tmp_path: Path):
    """`model/class` and `locate_ms` stood in no page; others:
    `test_a_command_of_a_page_ends_well`.
    """
    given = [
        "dataset=own",
        f"dataset.file={powers(tmp_path / 'own.npz', 60)}",
        "model=gp",
        "threads=1",
    ]
    train(compose(*given, "baselines=[nearest]", "logger=none"), tmp_path / "run")
    assert find_unexplained(tmp_path / "run") == []


@pytest.mark.parametrize("name", gsparc.__all__)
def test_whatever_is_public_says_what_it_is(name: str):
    public = getattr(gsparc, name)
    members = [
        (k, v) for k, v in inspect.getmembers(public) if k[0] != "_" and inspect.isclass(public)
    ]
    assert not [
        k for k, v in members if (callable(v) or isinstance(v, property)) and not inspect.getdoc(v)
    ]
