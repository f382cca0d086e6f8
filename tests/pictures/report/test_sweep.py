"""A sweep ends in one table and one figure; a failed job is said at once and takes none along."""

import csv
import json
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf

from gsparc.evaluation.console import ConsoleHandler
from gsparc.pictures.report.sweep import FAILURE, SweepReport, equal_settings


def of_job(folder: Path, mode: RunMode = RunMode.MULTIRUN):
    about = {"runtime": {"output_dir": str(folder)}, "overrides": {"task": ["seed=3"]}}
    return OmegaConf.create({"hydra": {"mode": mode, **about}})


def failed(error: Exception) -> JobReturn:
    job = JobReturn()
    job.return_value, job.status = error, JobStatus.FAILED
    return job


def test_a_failure_is_said_once_and_kept_and_the_sweep_goes_on(tmp_path, caplog):
    job, shown = failed(ValueError("no such file\nsecond line")), StringIO()
    SweepReport().on_job_end(of_job(tmp_path), job)
    assert job.status == JobStatus.COMPLETED and job.return_value is None
    assert (tmp_path / FAILURE).read_text() == "no such file\n"
    screen = ConsoleHandler(stream=shown)
    for record in caplog.records:
        screen.handle(record)
    assert shown.getvalue() == (
        f"error: job {tmp_path.name} (seed=3) failed, others go on: no such file\n"
    )
    assert "second line" in caplog.text  # in the job's own log


def of_sweep(folder: Path):
    return OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}})


def test_one_table_one_figure_and_a_page(three, tmp_path, capsys):
    SweepReport(retime=False).on_multirun_end(of_sweep(tmp_path))
    with (tmp_path / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method and setting"] for row in rows] == [
        "gsparc emission.hidden=8",
        "gsparc emission.hidden=64",
        "mean (baseline)",
        "gp (baseline)",
    ]
    assert rows[0]["seeds"] == "2" and rows[0]["PSNR dB least"] == "28.0"
    assert rows[0]["train s/fold"] == "10.0"
    assert (tmp_path / "sweep.png").stat().st_size > 20_000 and (tmp_path / "report.html").exists()
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert facts["sweep/runs"] == 3 and rows[1]["PSNR dB"] == "29.5"
    said = capsys.readouterr().out  # 80 columns may break an entry
    assert "28.20" in said and "28.40]" in said and "29.50" in said


def test_seeds_of_a_split_that_draw_no_test_rows_were_not_warned_of(run_dir, tmp_path, caplog):
    for draw in range(2):
        folder = run_dir(tmp_path / str(draw), overrides=(f"split.seed={draw}",))
        (folder / ".hydra/config.yaml").write_text(f"split: {{seed: {draw}}}")
    SweepReport(retime=False).on_multirun_end(of_sweep(tmp_path))
    assert caplog.text.count("the dataset names its test rows: say split.redraw=true") == 1


def test_jobs_named_after_a_path_still_end_in_a_table(three, tmp_path):
    """A path among the overrides puts a job's folder some levels down."""
    (tmp_path / "0_file-").mkdir()
    for number, run in enumerate(
        sorted(path for path in tmp_path.iterdir() if path.name != "0_file-")
    ):
        run.rename(tmp_path / "0_file-" / str(number))
    SweepReport(retime=False).on_multirun_end(of_sweep(tmp_path))
    assert (tmp_path / "sweep.csv").is_file()


def test_a_sweep_with_a_failed_job_ends_with_status_1(three, tmp_path, capsys):
    (tmp_path / "c0").mkdir()
    (tmp_path / "c0" / FAILURE).write_text("it broke\n")
    with pytest.raises(SystemExit) as end:
        SweepReport(retime=False).on_multirun_end(of_sweep(tmp_path))
    assert end.value.code == 1 and (tmp_path / "sweep.csv").exists()
    assert "1 jobs failed: c0" in capsys.readouterr().out


def test_settings_that_change_nothing_were_tabled_as_if_they_were_compared():
    def of(setting, seed, value, hidden):
        return setting, SimpleNamespace(
            facts={"seed": seed, "test/nmse": value, "time/train_s": hidden}
        )

    rows = [
        of("a", 0, 0.1, 1),
        of("a", 1, 0.2, 1),
        of("b", 1, 0.2, 2),
        of("b", 0, 0.1, 2),
        of("c", 0, 0.1, 3),
    ]
    assert equal_settings(pd.DataFrame(rows, columns=["setting", "run"])) == ["a, b"]
