"""A run that goes on from another one has its settings; a job that a launcher lost is said."""

import pytest

from gsparc.commands.shared.cli import _message_of
from gsparc.runs.continued import add_settings_of_run


def test_a_launcher_s_lost_job_is_said_with_what_to_do():
    lost = type("UncompletedJobError", (RuntimeError,), {"__module__": "submitit.core.utils"})
    said = _message_of(lost("Job 386 (task: 0) with path FILE\nhas not produced any output"))
    assert (
        "\n" not in said
        and "Job 386" in said
        and said.endswith("the same command goes on with the rest")
    )
    assert _message_of(ValueError("seed=x: no")) == "seed=x: no"


HYDRA = "hydra: {runtime: {cwd: WHERE}}"


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (
            [],
            [
                "dataset=own",
                "dataset.file='DATA'",
                "model.steps=5",
                "+trainer.x=1",
                "hydra.mode=RUN",
            ],
        ),
        (
            ["model.steps=7"],
            ["dataset=own", "dataset.file='DATA'", "+trainer.x=1", "hydra.mode=RUN"],
        ),
        (["model=gp"], ["dataset=own", "dataset.file='DATA'", "+trainer.x=1", "hydra.mode=RUN"]),
        (["dataset=rfid", "-m"], ["model.steps=5", "+trainer.x=1"]),
        (["~trainer.x"], ["dataset=own", "dataset.file='DATA'", "model.steps=5", "hydra.mode=RUN"]),
    ],
)
@pytest.mark.parametrize("of", ["run", "run/last.ckpt", "run/fold0/refit/last.ckpt"])
def test_a_run_to_go_on_from_brings_its_settings(tmp_path, of, words, kept):
    """`ckpt_path=RUN` loaded the default data and model,
    and was refused for not being those of the run.
    """
    notes, data = tmp_path / "run" / ".hydra", tmp_path / "site.npz"
    notes.mkdir(parents=True)
    data.touch()
    told = "[dataset=own, dataset.file=site.npz, model.steps=5, +trainer.x=1, ckpt_path=before]"
    (notes / "overrides.yaml").write_text(told)
    # Where the run was started
    (notes / "hydra.yaml").write_text(HYDRA.replace("WHERE", str(tmp_path)))
    line = [f"ckpt_path={tmp_path / of}", *words]
    kept = [one.replace("DATA", str(data)) for one in kept]
    here = [f"hydra.run.dir='{tmp_path / 'run'}'", "hydra.output_subdir=null"] * ("-m" not in words)
    assert add_settings_of_run(line) == [*kept, *here, *line]  # it finished in a folder of its own
    assert add_settings_of_run([*line, "hydra.run.dir=x"]) == [*kept, *line, "hydra.run.dir=x"]
    (tmp_path / "run" / "summary.json").touch()
    assert add_settings_of_run(line) == [*kept, *line]  # a finished one stays


def test_no_run_to_go_on_from_was_one_called_null(tmp_path, monkeypatch):
    """In a run's folder `ckpt_path=null` took the settings of that run."""
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text("- seed=3\n")
    (tmp_path / ".hydra" / "hydra.yaml").write_text(f"hydra: {{runtime: {{cwd: {tmp_path}}}}}\n")
    monkeypatch.chdir(tmp_path)
    assert add_settings_of_run(["ckpt_path=null"]) == ["ckpt_path=null"]


def test_a_command_line_without_a_run_to_go_on_from_stays(tmp_path):
    for line in (
        ["model=gp"],
        ["ckpt_path=null"],
        [f"ckpt_path={tmp_path / 'gone.ckpt'}", "seed=1"],
    ):
        assert add_settings_of_run(line) == line
