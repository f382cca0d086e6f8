"""A job of a multirun is done once; one that was cut short goes on from its own checkpoint."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from gsparc.commands.shared.cli import _message_of
from gsparc.commands.shared.continued import once, with_settings_of_run
from gsparc.commands.shared.run_lock import locked
from gsparc.evaluation.report.sweep import FAILURE


def job(**settings):
    return OmegaConf.create({"seed": 0, "ckpt_path": None, **settings})


def cut_short(folder, name="last.ckpt"):
    def work(config):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("state")
        raise KeyboardInterrupt

    return work


def test_a_finished_job_returns_what_it_returned(tmp_path):
    seen = []
    for _ in range(2):
        assert once(tmp_path, job(), lambda config: seen.append(config.seed) or 7.5) == 7.5
    assert seen == [0]
    assert once(tmp_path, job(seed=1), lambda config: seen.append(config.seed) or 8.5) == 8.5
    assert seen == [0, 1]


@pytest.mark.parametrize(
    ("left", "resumed"), [("last.ckpt",) * 2, ("refit/last.ckpt",) * 2, ("fold1/last.ckpt", "")]
)
def test_an_interrupted_job_goes_on_and_then_counts_as_done(tmp_path, left, resumed):
    with pytest.raises(KeyboardInterrupt):
        once(tmp_path, job(), cut_short(tmp_path, left))
    (tmp_path / FAILURE).write_text("of the first try")
    seen = []
    assert once(tmp_path, job(), lambda config: seen.append(config.ckpt_path) or 1.0) == 1.0
    assert seen == [str(tmp_path / resumed)] and not (tmp_path / FAILURE).exists()
    assert once(tmp_path, job(), lambda config: 2.0) == 1.0


def test_a_checkpoint_of_other_settings_is_not_gone_on_from(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        once(tmp_path, job(), cut_short(tmp_path))
    with pytest.raises(RuntimeError):
        once(tmp_path, job(seed=1), lambda config: (_ for _ in ()).throw(RuntimeError))
    seen = []
    once(tmp_path, job(seed=1), lambda config: seen.append(config.ckpt_path) or 1.0)
    assert seen == [None]


@pytest.mark.parametrize("what", ["file", "root"])
def test_a_finished_job_answered_for_the_file_before(tmp_path, what):
    """Other measurements under the same name had the figures of those before."""
    data = tmp_path / "release" / "drive.csv"
    data.parent.mkdir()
    named, seen = job(dataset={what: str(data if what == "file" else data.parent)}), []
    for content in ("x,y,rssi_db\n", "x,y,rssi_db\n", "x,y,z,rssi_db\n"):
        if not data.exists() or data.read_text() != content:
            data.write_text(content)
        once(tmp_path, named, lambda config: seen.append(data.read_text()) or 1.0)
    assert len(seen) == 2 and seen[0] != seen[1]


def test_the_same_run_said_again_began_anew_without_a_word(tmp_path):
    """In its folder it goes on where it was interrupted; one that has ended is done again."""
    seen = []
    with pytest.raises(KeyboardInterrupt):
        once(tmp_path, job(), cut_short(tmp_path, "station0/model.ckpt"), again=True)
    for _ in range(2):
        assert once(tmp_path, job(), lambda config: seen.append(config.ckpt_path) or 1.0, again=True) == 1.0
    assert seen == [str(tmp_path), None]


def test_a_job_that_another_process_does_is_refused(tmp_path):
    with locked(tmp_path / ".job"), pytest.raises(ValueError, match="another run writes here"):
        once(tmp_path, job(), lambda config: 1.0)


def test_a_launcher_s_lost_job_is_said_with_what_to_do():
    lost = type("UncompletedJobError", (RuntimeError,), {"__module__": "submitit.core.utils"})
    said = _message_of(lost("Job 386 (task: 0) with path FILE\nhas not produced any output"))
    assert "\n" not in said and "Job 386" in said and said.endswith("the same command goes on with the rest")
    assert _message_of(ValueError("seed=x: no")) == "seed=x: no"


def test_a_run_among_its_own_data_was_done_again(tmp_path):
    """What a run writes under `dataset.root=.` is no change of the data."""
    (tmp_path / "a.csv").write_text("x")
    seen, config = [], job(dataset={"root": str(tmp_path)})
    for _ in range(2):
        once(tmp_path / "runs" / "1", config, lambda config: seen.append(1) or 7.5)
        (tmp_path / "runs" / "1" / "summary.json").write_text("{}" * (1 + len(seen)))
    assert seen == [1]
    (tmp_path / "a.csv").write_text("changed")
    once(tmp_path / "runs" / "1", config, lambda config: seen.append(1) or 7.5)
    assert seen == [1, 1]


HYDRA = "hydra: {runtime: {cwd: WHERE}}"


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        ([], ["dataset=own", "dataset.file='DATA'", "model.steps=5", "+trainer.x=1", "hydra.mode=RUN"]),
        (["model.steps=7"], ["dataset=own", "dataset.file='DATA'", "+trainer.x=1", "hydra.mode=RUN"]),
        (["model=gp"], ["dataset=own", "dataset.file='DATA'", "+trainer.x=1", "hydra.mode=RUN"]),
        (["dataset=rfid", "-m"], ["model.steps=5", "+trainer.x=1"]),
        (["~trainer.x"], ["dataset=own", "dataset.file='DATA'", "model.steps=5", "hydra.mode=RUN"]),
    ],
)
@pytest.mark.parametrize("of", ["run", "run/last.ckpt", "run/fold0/refit/last.ckpt"])
def test_a_run_to_go_on_from_brings_its_settings(tmp_path, of, words, kept):
    """`ckpt_path=RUN` loaded the default data and model, and was refused for not being those of the run."""
    notes, data = tmp_path / "run" / ".hydra", tmp_path / "site.npz"
    notes.mkdir(parents=True)
    data.touch()
    told = "[dataset=own, dataset.file=site.npz, model.steps=5, +trainer.x=1, ckpt_path=before]"
    (notes / "overrides.yaml").write_text(told)
    (notes / "hydra.yaml").write_text(HYDRA.replace("WHERE", str(tmp_path)))  # where the run was started
    line = [f"ckpt_path={tmp_path / of}", *words]
    assert with_settings_of_run(line) == [*(one.replace("DATA", str(data)) for one in kept), *line]


def test_a_command_line_without_a_run_to_go_on_from_stays(tmp_path):
    for line in (["model=gp"], ["ckpt_path=null"], [f"ckpt_path={tmp_path / 'gone.ckpt'}", "seed=1"]):
        assert with_settings_of_run(line) == line
