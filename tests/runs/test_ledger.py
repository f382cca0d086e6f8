"""A cell is done once for the same settings, files, data, split and program;
one cut short goes on.
"""

import importlib
import os
import sys
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
from campaigns import compose, spectra
from omegaconf import OmegaConf

from gsparc.data.split_files import write_split
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.summary import write_summary
from gsparc.runs import ledger
from gsparc.runs.inputs import read_inputs
from gsparc.runs.ledger import (
    FAILURE,
    FitInputs,
    edited,
    measurements_hash,
    program,
    read_finished,
    run_once,
)
from gsparc.tables.said_columns import beside


def state(**changes) -> FitInputs:
    return FitInputs(
        **({"settings": {"seed": 0}, "files": {}, "data": "d", "split": "s"} | changes)
    )


def ends(folder, value=1.0, seen=None):
    """Work that ends with this value, and notes what it was given to go on from."""

    def work(left):
        if seen is not None:
            seen.append(left)
        write_summary(folder / "summary.json", {"value": value})

    return work


def cut_short(folder, name="last.ckpt"):
    def work(left):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("state")
        raise KeyboardInterrupt

    return work


@pytest.mark.parametrize(
    "other",
    [
        {"settings": {"seed": 1}},
        {"files": {"init.file": "0"}},
        {"data": "e"},
        {"split": "t"},
    ],
)
def test_a_cell_is_done_once_in_one_state(tmp_path, other):
    assert run_once(tmp_path, state(), ends(tmp_path, 1)) == run_once(
        tmp_path, state(), ends(tmp_path, 2)
    )
    assert read_finished(tmp_path, state(**other)) is None
    assert run_once(tmp_path, state(**other), ends(tmp_path, 3)) == {"value": 3}
    assert read_finished(tmp_path, state()) is None
    assert run_once(tmp_path, state(**other), ends(tmp_path, 4), again=True) == {"value": 4}
    (tmp_path / "summary.json").write_text("{")  # no whole one
    assert read_finished(tmp_path, state(**other)) is None


@pytest.mark.parametrize(
    ("name", "resumed"),
    [
        ("last.ckpt",) * 2,
        ("refit/last.ckpt",) * 2,
        ("fold1/last.ckpt", ""),
        ("station0/model.ckpt", ""),
    ],
)
@pytest.mark.parametrize("again", [False, True])
def test_an_interrupted_job_goes_on_and_then_counts_as_done(tmp_path, name, resumed, again):
    """The same run said again began anew without a word;
    one that has ended is done again by itself alone.
    """
    with pytest.raises(KeyboardInterrupt):
        run_once(tmp_path, state(), cut_short(tmp_path, name), again=again)
    (tmp_path / FAILURE).write_text("of the first try")
    seen = []
    for _ in range(2):
        run_once(tmp_path, state(), ends(tmp_path, 1, seen), again=again)
    assert (
        seen == [str(tmp_path / resumed), *([None] * again)] and not (tmp_path / FAILURE).exists()
    )


def test_a_job_killed_after_its_record_took_the_summary_of_another_state(tmp_path):
    run_once(tmp_path, state(), ends(tmp_path, 1))
    with pytest.raises(KeyboardInterrupt):
        run_once(tmp_path, state(data="e"), cut_short(tmp_path))
    assert not (tmp_path / "summary.json").exists()


def of(file, *words) -> FitInputs:
    """The state of a run on a table of spectra."""
    config = compose("dataset=own", f"dataset.file='{file}'", "model=mean", "logger=none", *words)
    begun = read_inputs(config)
    return FitInputs.from_config(config, measurements_hash(begun.data), begun.split.sha256)


def test_a_finished_job_answered_for_a_split_file_of_before(tmp_path):
    """A sweep said again after `split.json` had changed:
    3.94 dB of 60 rows where 5.40 of 64 are right.
    """
    file, split = spectra(tmp_path / "own.npz"), tmp_path / "split.json"
    words = "split=file", f"split.path='{split}'"
    states = []
    for test in ([8, 9], [7, 9]):
        folds = (Fold(np.arange(5), np.array([5, 6]), np.array(test)),)
        write_split(split, Split("own", folds), 40)
        states.append(of(file, *words))
    assert states[0].split != states[1].split and states[0].settings == states[1].settings


def test_a_finished_job_answered_for_data_of_equal_size_and_time(tmp_path):
    file, states = tmp_path / "own.npz", []
    for factor in (1, 2):
        spectra(file)
        arrays = dict(np.load(file))
        if factor == 2:
            name = next(
                key for key, value in arrays.items() if value.dtype.kind == "f" and value.ndim > 1
            )
            arrays[name] = arrays[name][::-1]
        np.savez(file, **arrays)
        os.utime(file, (1e9, 1e9))
        states.append((file.stat().st_size, file.stat().st_mtime_ns, of(file)))
    (*one, before), (*other, after) = states
    assert one == other and before.data != after.data
    (tmp_path / "moved").mkdir()
    moved = file.rename(tmp_path / "moved" / file.name)
    assert of(moved) == after  # where the file is does not matter


def test_a_job_found_done_read_its_data_first(tmp_path):
    """Seconds for each job of a sweep said again; files of the same bytes say the same."""
    file = spectra(tmp_path / "own.npz")
    configs = [
        compose("dataset=own", f"dataset.file='{file}'", "model=mean", f"seed={n}") for n in (0, 1)
    ]
    unread, other = map(FitInputs.from_config, configs)
    run_once(tmp_path, replace(unread, data="d", split="s"), ends(tmp_path))
    assert (
        read_finished(tmp_path, unread) == {"value": 1} and read_finished(tmp_path, other) is None
    )
    with file.open("ab") as stream:
        stream.write(b" ")
    assert read_finished(tmp_path, FitInputs.from_config(configs[0])) is None
    assert read_finished(tmp_path, FitInputs.from_config(configs[0], "d", "s")) == {"value": 1}
    release = compose("dataset=rfid", f"dataset.root='{tmp_path}'", "model=mean")
    before = FitInputs.from_config(release)
    (tmp_path / "more.txt").touch()
    assert before.tells_data and before != FitInputs.from_config(release)
    assert not FitInputs.from_config(
        compose("dataset=rfid", "dataset.root=null", "model=mean")
    ).tells_data


def test_a_job_was_done_though_the_file_about_its_columns_was_edited(tmp_path):
    (file := tmp_path / "log.csv").write_text("x,y,rssi\n0,0,-60\n")
    config = compose("dataset=own", f"dataset.file='{file}'", "model=mean")
    before = FitInputs.from_config(config)
    run_once(tmp_path, replace(before, data="d", split="s"), ends(tmp_path))
    beside(file).write_text("heads: 0\ncolumns: []\nwritten: by hand\n")
    edited_since = FitInputs.from_config(config)
    assert edited_since.changes(vars(before), reuse=True) == ["unread.dataset.file (columns)"]
    assert read_finished(tmp_path, edited_since, reuse=True) is None


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Write a module `lone_plugin`, which imports `lone_helper`; return their folder."""
    folder = tmp_path / "plugin"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    (folder / "lone_plugin.py").write_text("import lone_helper\n")
    (folder / "lone_helper.py").write_text('"""Of a value."""\nVALUE = 1\n')
    importlib.import_module("lone_plugin")
    yield folder
    for name in ("lone_plugin", "lone_helper"):
        sys.modules.pop(name, None)


def test_a_new_program_in_the_clone_threw_finished_sweeps_away(tmp_path, plugin):
    run_once(tmp_path, state(), ends(tmp_path, 1))
    (plugin / "lone_other.py").write_text("VALUE = 2\n")  # that nobody imports
    assert read_finished(tmp_path, state()) == {"value": 1}


def test_cells_were_current_whose_method_s_own_files_had_changed(monkeypatch):
    """The key of `gp` hashed 2 files, and none of those of its process."""
    monkeypatch.setattr(ledger, "_edition", ledger._edition.__wrapped__)
    found = []
    for commit, edits in (("a", ""), ("b", ""), ("b-dirty", "+ 1"), ("b-dirty", "+ 2")):
        monkeypatch.setattr(ledger, "provenance", lambda commit=commit: {"git": commit})
        monkeypatch.setattr(ledger, "run_git", lambda *_, edits=edits: edits)
        found.append(program()["gsparc"])
        assert edited({"program": program()}) == []
    assert len({*found}) == 4 and not {"numpy", "gsparc.runs.ledger"} & {*program()}
    monkeypatch.setattr(ledger, "provenance", lambda: {"git": None})
    assert program()["gsparc"] == version("gsparc")


@pytest.mark.parametrize("how", ["folder", "list", "link", "inner link", "nested"])
def test_files_that_a_setting_names_in_a_list_a_folder_or_behind_a_link_count_by_content(
    tmp_path, how
):
    """A sweep answered of the maps of before: `model.prior=FOLDER`, `[a.tif,b.tif]`,
    a linked `spectrum/`.
    """
    (folder := tmp_path / "maps").mkdir()
    for name in ("a.tif", "b.tif"):
        (folder / name).write_text(name)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "spectrum").symlink_to(folder)
    (folder / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "link").symlink_to(folder)
    value = {
        "folder": str(folder),
        "list": [str(folder / "a.tif"), str(folder / "b.tif")],
        "link": str(tmp_path / "link"),
        "inner link": str(tmp_path / "in"),
        "nested": [{"of": [str(folder / "b.tif")]}],
    }[how]

    def of():
        return FitInputs.from_config(
            OmegaConf.create({"model": {"prior": value, "name": str(folder)}})
        )

    before = of()
    assert before == of() and [*before.files] == ["model.prior"]
    run_once(tmp_path / "in" / "fit", before, ends(tmp_path / "in" / "fit"))
    assert of() == before  # what fits write there is none of what they read
    (folder / "b.tif").write_text("changed")
    assert of().files != before.files and of().settings == before.settings


def test_a_job_that_begins_anew_says_why(tmp_path, caplog):
    caplog.set_level("INFO", "gsparc")
    run_once(tmp_path, state(), ends(tmp_path, 1))
    assert not caplog.messages
    run_once(tmp_path, state(settings={"seed": 0, "effort": 2}), ends(tmp_path, 1))
    assert caplog.messages == [
        f"{tmp_path}: runs again, as these changed since it ran: settings.effort"
    ]


def test_a_folder_that_a_callback_writes_to_made_a_killed_job_begin_anew(tmp_path):
    """It is no input: what the first try had written there counted as a change."""
    config = OmegaConf.create({"callbacks": {"kill": {"folder": str(tmp_path)}}})
    before = FitInputs.from_config(config)
    (tmp_path / "steps").write_text("1")
    assert FitInputs.from_config(config) == before and not before.files
