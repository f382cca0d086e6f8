"""Cells of a comparison: what names one, what is found again, what is not."""

import errno
import json

import pytest
from hydra import initialize_config_module

from gsparc.evaluation.results import Run, as_frame
from gsparc.evaluation.summary import write_summary
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.runs.experiment.cells import Cell, _may_match, job_of_cell
from gsparc.runs.experiment.contenders import Contender
from gsparc.runs.experiment.problem import Problem
from gsparc.runs.experiment.runner import run_jobs, time_by_dataset
from gsparc.runs.ledger import run_once


@pytest.fixture
def problem(campaign, folds):
    return Problem(
        "own", "random", ("dataset=own", "split=random"), campaign("spectrum", 20), folds(20), "d"
    )


def test_a_cell_whose_model_is_gone_is_not_timed(tmp_path):
    """Times that a comparison had kept stood in tables of other programs' models."""
    gone = Run(tmp_path / "gp", {}).rows()[0] | {"dataset": "toy", "split": "random"}
    assert time_by_dataset(as_frame([gone])).empty


def prepared(problem, folder, model="gsparc", effort=0.5, seed=0, settings=None, choose=()):
    """A cell as it is before it is filled."""
    contender = Contender(model, (f"model={model}", *choose), True)
    cell = Cell("own", "random", model, effort, seed)
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return job_of_cell(cell, contender, {"file": "x", **(settings or {})}, problem, folder)


@pytest.mark.parametrize(
    "changes",
    [
        [{"model": "gsparc"}, {"model": "gsparc", "effort": 1.0}],
        # The first seed of gsparc stood for all three: a spread of 0.00.
        [{"model": "gsparc", "seed": seed} for seed in range(3)],
        [{"model": "moving_array", "seed": seed} for seed in range(3)],
        # These settings stand beside the model's:
        # a table of batches of 4 showed cells of batches of 16.
        [{}, {"settings": {"batch_size": 4}}],
        [{}, {"choose": ("init_from=model.ckpt",)}],
    ],
)
def test_a_cell_was_taken_for_one_of_another_batch_effort_or_start(changes, tmp_path, problem):
    found = [prepared(problem, tmp_path, **change) for change in changes]
    states = [one.state for one in found]
    assert all(one not in states[:number] for number, one in enumerate(states))
    assert found[0].config.effort == 0.5


def test_a_cell_of_another_program_is_named_by_its_commit(tmp_path, problem):
    """Published results outlive the program they were measured with: a table says so."""
    one = prepared(problem, tmp_path, "mean")
    assert one.folder == tmp_path / "own" / "random" / "mean" / "0.5" / "0"
    run_once(
        one.folder,
        one.state,
        lambda left: write_summary(one.folder / "summary.json", {"git": "0123456789"}),
    )
    assert one.row()["earlier"] == ""
    record = json.loads((one.folder / "job.json").read_text())
    record["program"]["gsparc.models"] = "another"
    (one.folder / "job.json").write_text(json.dumps(record))
    assert one.row()["earlier"] == "01234567"


def test_a_full_disk_ends_a_comparison(problem, tmp_path):
    """Every further cell was trained in vain; then `no cell is filled (train=true fills them)`."""
    tried = []

    def full(one, left):
        tried.append(one)
        raise CheckpointError("m.ckpt: cannot be written") from OSError(
            errno.ENOSPC, "No space left"
        )

    cells = [prepared(problem, tmp_path, method) for method in ("mean", "gp")]
    with pytest.raises(CheckpointError, match="cannot be written"):
        run_jobs(cells, full)
    assert len(tried) == 1


@pytest.mark.parametrize(
    ("pattern", "rfid", "newrf"),
    [
        # One star stands for dataset and split: rooms were left out without a word
        ("*/gp/*", True, True),
        ("newrf/*", False, True),
        ("new*/60/0", False, True),
        ("rfid/random/gp/any/any", True, False),
        ("*", True, True),
        ("rfid/sparse/*", False, False),
    ],
)
def test_a_star_may_stand_for_several_parts_of_a_cell(pattern, rfid, newrf):
    assert _may_match(pattern, "rfid", "random") == rfid
    assert _may_match(pattern, "newrf", "random") == newrf
