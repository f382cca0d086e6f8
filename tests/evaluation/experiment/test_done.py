"""A cell is done once for the same settings, files, data, split and program; one cut short goes on."""

import ast
import os
import sys
from importlib.util import spec_from_file_location
from pathlib import Path

import numpy as np
import pytest
from campaigns import compose, spectra
from omegaconf import OmegaConf

import gsparc
from gsparc.commands.train import read_inputs
from gsparc.data.split_files import write_split
from gsparc.data.splits import Fold, Split, hash_indices
from gsparc.evaluation.experiment import done
from gsparc.evaluation.experiment.done import (
    FAILURE,
    State,
    measurements_hash,
    package_hash,
    program_files,
    read_finished,
    recorded,
    run_once,
    strip_comments,
)
from gsparc.evaluation.summary import write_summary


def state(**changes) -> State:
    return State(
        **({"settings": {"seed": 0}, "files": {}, "data": "d", "split": "s", "program": "p"} | changes)
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


@pytest.mark.parametrize("other", [
    {"settings": {"seed": 1}},
    {"files": {"init.file": "0"}},
    {"data": "e"},
    {"split": "t"},
    {"program": "q"},
])  # fmt: skip
def test_a_cell_is_done_once_in_one_state(tmp_path, other):
    assert run_once(tmp_path, state(), ends(tmp_path, 1)) == run_once(tmp_path, state(), ends(tmp_path, 2))
    assert read_finished(tmp_path, state(**other)) is None
    assert run_once(tmp_path, state(**other), ends(tmp_path, 3)) == {"value": 3}
    assert read_finished(tmp_path, state()) is None
    assert run_once(tmp_path, state(**other), ends(tmp_path, 4), again=True) == {"value": 4}
    (tmp_path / "summary.json").write_text("{")  # no whole one
    assert read_finished(tmp_path, state(**other)) is None


def test_another_program_s_result_counts_where_that_is_asked(tmp_path):
    run_once(tmp_path, state(), ends(tmp_path, 1))
    assert run_once(tmp_path, state(program="q"), ends(tmp_path, 2), reuse=True) == {"value": 1}
    assert run_once(tmp_path, state(program="q"), ends(tmp_path, 2)) == {"value": 2}


@pytest.mark.parametrize(
    ("name", "resumed"),
    [("last.ckpt",) * 2, ("refit/last.ckpt",) * 2, ("fold1/last.ckpt", ""), ("station0/model.ckpt", "")],
)
@pytest.mark.parametrize("again", [False, True])
def test_an_interrupted_job_goes_on_and_then_counts_as_done(tmp_path, name, resumed, again):
    """The same run said again began anew without a word; one that has ended is done again by itself alone."""
    with pytest.raises(KeyboardInterrupt):
        run_once(tmp_path, state(), cut_short(tmp_path, name), again=again)
    (tmp_path / FAILURE).write_text("of the first try")
    seen = []
    for _ in range(2):
        run_once(tmp_path, state(), ends(tmp_path, 1, seen), again=again)
    assert seen == [str(tmp_path / resumed), *([None] * again)] and not (tmp_path / FAILURE).exists()


def test_a_checkpoint_of_another_state_is_not_gone_on_from(tmp_path):
    for program in "pq":
        with pytest.raises(KeyboardInterrupt):
            run_once(tmp_path, state(program=program), cut_short(tmp_path))
    seen = []
    run_once(tmp_path, state(), ends(tmp_path, 1, seen))
    assert seen == [None]


def test_a_job_killed_after_its_record_took_the_summary_of_another_state(tmp_path):
    run_once(tmp_path, state(), ends(tmp_path, 1))
    with pytest.raises(KeyboardInterrupt):
        run_once(tmp_path, state(data="e"), cut_short(tmp_path))
    assert not (tmp_path / "summary.json").exists()


def of(file, *words) -> State:
    """The state of a run on a table of spectra."""
    config = compose("dataset=own", f"dataset.file='{file}'", "model=mean", "logger=none", *words)
    begun = read_inputs(config)
    return State.from_config(config, measurements_hash(begun.module.measurements), begun.split.sha256)


def test_a_finished_job_answered_for_a_split_file_of_before(tmp_path):
    """A sweep said again after `split.json` had changed: 3.94 dB of 60 rows where 5.40 of 64 are right."""
    file, split = spectra(tmp_path / "own.npz"), tmp_path / "split.json"
    words = "split=file", f"split.path='{split}'"
    states = []
    for test in ([8, 9], [7, 9]):
        folds = (Fold(np.arange(5), np.array([5, 6]), np.array(test)),)
        write_split(split, Split("own", folds, hash_indices(folds)), 40)
        states.append(of(file, *words))
    assert states[0].split != states[1].split and states[0].settings == states[1].settings


def test_a_finished_job_answered_for_data_of_equal_size_and_time(tmp_path):
    file, states = tmp_path / "own.npz", []
    for factor in (1, 2):
        spectra(file)
        arrays = dict(np.load(file))
        if factor == 2:
            name = next(key for key, value in arrays.items() if value.dtype.kind == "f" and value.ndim > 1)
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
    file, read = spectra(tmp_path / "own.npz"), state()
    configs = [compose("dataset=own", f"dataset.file='{file}'", "model=mean", f"seed={n}") for n in (0, 0, 1)]
    unread, same, other = map(State.unread, configs)
    with recorded(tmp_path, read, unread) as left:
        ends(tmp_path)(left)
    assert read_finished(tmp_path, same) == {"value": 1} and read_finished(tmp_path, other) is None
    with file.open("ab") as stream:
        stream.write(b" ")
    assert read_finished(tmp_path, State.unread(configs[0])) is None
    release = compose("dataset=rfid", f"dataset.root='{tmp_path}'", "model=mean")
    before = State.unread(release)
    (tmp_path / "more.txt").touch()
    assert before and before != State.unread(release)
    assert State.unread(compose("dataset=rfid", "dataset.root=null", "model=mean")) is None


def test_commits_of_comments_alone_made_every_cell_stale():
    """What is hashed of a file differs from it in comments, empty lines and docstrings alone."""
    for file in sorted(Path(gsparc.__file__).parent.rglob("*.py"))[::12]:
        tree = ast.parse(text := file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
                node.body[0].value.value = ""
        assert ast.dump(ast.parse(strip_comments(text))) == ast.dump(tree), file
    assert strip_comments("x = 1  # one\n") == strip_comments("x = 1\n") != strip_comments("x = 2\n")


def test_text_after_a_colon_was_taken_for_a_docstring():
    one, two = (f'WORDS = {{\n    "a":\n        """{word}""",\n}}\n' for word in ("one", "two"))
    assert strip_comments(one) != strip_comments(two)
    assert "said" not in strip_comments('def f(\n    x,\n) -> int:\n    """said"""\n    return x\n')


def test_a_plugin_s_helper_or_weights_were_edited_and_it_counted_as_done(tmp_path, monkeypatch):
    """Two jobs were done already, 2.93 dB where over 20 is right."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lone_plugin.py").write_text("import lone_helper\n")
    (tmp_path / "lone_parts").mkdir()
    files = ["lone_helper.py", "weights.npz", "lone_parts/__init__.py", "lone_parts/table.csv"]
    for name in files:
        (tmp_path / name).write_text("1\n")
    hashes = [package_hash("lone_plugin")]
    for name in files:
        (tmp_path / name).write_text("2\n")
        hashes.append(package_hash("lone_plugin"))
    assert len({*hashes}) == 5
    (tmp_path / "outputs").mkdir()  # of runs
    (tmp_path / "outputs" / "summary.json").write_text("{}")
    assert package_hash("lone_plugin") == hashes[-1]


def test_a_file_that_a_setting_names_counts_by_its_content(tmp_path):
    walls, states = tmp_path / "walls.yaml", []
    for text in ("[]", "[1]"):
        walls.write_text(text)
        states.append(
            State.from_config(OmegaConf.create({"init": {"file": str(walls)}, "workers": len(text)}))
        )
    assert states[0].files != states[1].files and states[0].settings == states[1].settings


def test_cells_were_current_whose_method_s_own_files_had_changed(tmp_path, monkeypatch):
    """The key of `gp` hashed 2 files, and none of those of its process."""
    _, files = program_files("gsparc")
    assert "gsparc/processes/kernel.py" in files and any("ops/" in one for one in files)
    package = tmp_path / "toy_program"
    (package / "processes").mkdir(parents=True)
    module, page = package / "processes" / "x.py", tmp_path / "page.md"
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    hashes = []
    for text in ("VALUE = 1\n", "VALUE = 2\n"):
        module.write_text(text)
        hashes.append(package_hash("toy_program"))
    assert len(set(hashes)) == 2
    page.write_text("other words")
    assert package_hash("toy_program") == hashes[-1]
    module.write_text('"""Of a value."""\n\nVALUE = 2  # in metres\n')
    commented = package_hash("toy_program")
    module.write_text('"""Of another."""\nVALUE = 2\n')
    assert package_hash("toy_program") == commented
    sys.modules.pop("toy_program", None)


def test_a_new_program_in_the_clone_threw_finished_sweeps_away(tmp_path, monkeypatch):
    package = tmp_path / "clone" / "gsparc"
    (package / "models").mkdir(parents=True)
    (tmp_path / "clone" / "mine").mkdir()
    for name in ("mine/own.py", "own.py", "gsparc/__init__.py", "gsparc/models/new.py"):
        (tmp_path / "clone" / name).touch()
    found = spec_from_file_location("gsparc", package / "__init__.py")
    monkeypatch.setattr(done, "find_spec", lambda name: found)
    assert sorted(program_files("gsparc")[1]) == ["gsparc/__init__.py", "gsparc/models/new.py"]


def test_a_job_that_begins_anew_says_why(tmp_path, caplog):
    caplog.set_level("INFO", "gsparc")
    run_once(tmp_path, state(), ends(tmp_path, 1))
    assert not caplog.messages
    run_once(tmp_path, state(settings={"seed": 0, "effort": 2}, program="q"), ends(tmp_path, 1))
    assert caplog.messages == [f"{tmp_path}: begun anew, as these changed: program, settings.effort"]
    module = Path(gsparc.__file__).parent / "models" / "gsparc.py"
    began = module.stat().st_mtime - 1e-3
    said = state(program="q").changes({**vars(state()), "began": began})
    assert said[0] == "program" and "gsparc/models/gsparc.py" in said
