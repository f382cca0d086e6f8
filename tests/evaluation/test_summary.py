"""What a run leaves behind."""

import json
import os
import re
import runpy
import shutil
import subprocess

import numpy as np
import pytest
import torch
from refusals import refused
from rich.console import Console

from gsparc.evaluation import provenance as provenance_module
from gsparc.evaluation.provenance import program_version, provenance, run_git
from gsparc.evaluation.summary import describe_model, remarks, results_table, write_summary

INFINITE = [float("nan"), float("inf"), np.float32("nan"), torch.tensor(-torch.inf)]


@pytest.mark.parametrize("bad", [*INFINITE, [1], {"a": 1}, np.ones(2), 1j])
def test_what_is_not_finite_or_flat_is_refused_by_name(tmp_path, bad):
    path = tmp_path / "summary.json"
    write_summary(path, {"test/ssim": 0.5})
    refused("test/psnr_db", write_summary, path, {"test/ssim": 0.6, "test/psnr_db": bad})
    assert json.loads(path.read_text()) == {"test/ssim": 0.5}


def test_table_shows_no_accuracy_without_its_time():
    facts = {
        "dataset/kind": "spectrum",
        "test/ssim": 0.91234,
        "test/psnr_db": 30.0,
        "time/train_s": 123.0,
        "time/render_ms_p50": 1.25,
        "baseline/gp/ssim": 0.9,
        "baseline/gp/train_s": 0.5,
        "baseline/gp/render_ms_p50": 2.5,
        "baseline/zero/ssim": 0.001,
    }
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(results_table(facts, "gsparc", "toy"))
    lines = [line for line in console.export_text().splitlines() if "│" in line]
    cells = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in lines]
    assert [row[0] for row in cells] == ["zero", "gp", "gsparc"]
    # Without columns of dashes alone
    assert cells[2] == ["gsparc", "30.00", "0.9123", "123", "1.25"]
    assert cells[1][-2:] == ["0.5", "2.5"]
    facts |= {"test/reduced_chi2": 1.061, "baseline/gp/reduced_chi2": 3.0}
    heads, rows = results_table(facts, "gsparc").texts()
    assert dict(zip(heads, rows[-1], strict=True))["reduced_chi2"] == "1.06" and "3.00" in rows[1]


def test_commit_is_known_inside_the_tree_only(tmp_path):
    facts = provenance()
    assert "torch" in facts["versions"] and "python 3" in facts["versions"]
    outside = tmp_path / "provenance.py"
    shutil.copy(provenance_module.__file__, outside)
    # Inside another project's repository an untracked copy must not claim that project's commit.
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    assert runpy.run_path(str(outside))["provenance"]()["git"] is None


def test_a_killed_run_left_a_lock_in_the_repository(tmp_path):
    """`git status` rewrites an index whose times have changed;
    a SIGKILL then left `.git/index.lock`.
    """
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    file = tmp_path / "file"
    file.write_text("text")
    subprocess.run(["git", "-C", str(tmp_path), "add", "file"], check=True)
    index = tmp_path / ".git" / "index"
    os.utime(file, (1, 1))
    before = index.read_bytes()
    assert run_git(tmp_path, "status", "--porcelain") == "A  file"
    assert index.read_bytes() == before


def test_remarks_name_stand_ins_busy_machines_and_better_baselines():
    facts = {
        "dataset/kind": "csi",
        "dataset/stand_in": "rfid",
        "machine/load": 3.0,
        "test/nmse": 0.2,
    }
    facts |= {"baseline/gp/nmse": 0.1, "baseline/idw/nmse": 0.3}
    said = " | ".join(remarks(facts))
    for words in ("do not describe the rfid release", "load 3.0", "gp has the better nmse"):
        assert words in said
    assert "idw" not in said
    quiet = {
        "dataset/kind": "spectrum",
        "dataset/stand_in": None,
        "machine/load": 0.5,
        "test/psnr_db": 30.0,
    }
    quiet["baseline/gp/psnr_db"] = 29.0
    assert remarks(quiet) == []
    assert "gp" in remarks({**quiet, "baseline/gp/psnr_db": 31.0})[0]


@pytest.mark.parametrize(
    ("kind", "made", "learned", "said"),
    [
        (
            "ImageSources",
            "rays in closed form",
            None,
            ["gsparc: image sources, rays in closed form"],
        ),
        ("ArrayProcess", "array process through 9", None, ["gsparc: array process through 9"]),
        (
            "Powers",
            "joint_powers in closed form",
            None,
            ["gsparc: powers of all stations in closed form"],
        ),
        (
            "Powers",
            "powers in closed form",
            "length 3 m\na law\nc\nd\ne",
            ["gsparc: powers in closed form", "  length 3 m", "  a law", "  c", "  d"],
        ),
    ],
)
def test_the_console_never_said_which_method_was_chosen(kind, made, learned, said):
    facts = {
        "dataset/kind": "csi",
        "model/label": "gsparc",
        "model/class": kind,
        "model/made": made,
    }
    assert remarks({**facts, "model/learned": learned}) == said
    folds = remarks({**facts, "model/learned": learned, "split/folds": 5})
    assert folds == ["of the first of 5 folds:", *said], (
        "steps of one fold were shown as those of all"
    )


@pytest.mark.parametrize("prefix", ["train", "val"])
def test_rows_that_were_learned_from_were_shown_like_unseen_ones(prefix):
    """gp with 0.11 dB on val rows stood beside gp (baseline) with 1.15,
    which had not learned them.
    """
    facts = {"dataset/kind": "rssi", f"{prefix}/rmse_db": 0.11, "baseline/gp/rmse_db": 1.15}
    assert "eval_on=test" in remarks(facts, prefix)[0]


def test_a_baseline_was_better_by_chance_or_by_nothing():
    """At 1.42 against 1.42 dB a baseline had the better figure;
    28.91 against 29.13 dB was no word.
    """
    facts = {"dataset/kind": "rssi", "model/label": "gsparc", "test/rmse_db": 1.42}
    facts |= {
        "baseline/gp/rmse_db": 1.42,
        "baseline/gp/ahead_db": 0.0,
        "baseline/gp/ahead_error_db": 0.0,
    }
    facts["baseline/gp/ahead_pairs"] = "24 test rows"
    assert remarks(facts) == ["the baseline gp and gsparc have the same rmse_db over 24 test rows"]
    assert remarks(
        {**facts, "baseline/gp/ahead_db": -0.22, "baseline/gp/ahead_error_db": 0.14}
    ) == [
        "the baseline gp and gsparc do not differ significantly in rmse_db: "
        "gsparc is 0.22 ± 0.14 (standard error) dB better over 24 test rows"
    ]
    ((said),) = remarks({**facts, "baseline/gp/ahead_db": 0.3, "baseline/gp/ahead_error_db": 0.1})
    assert (
        "gp is 0.30 ± 0.10 (standard error) dB better over 24 test rows in rmse_db: the better "
        "choice" in said
    )
    assert remarks({**facts, "baseline/gp/ahead_db": -0.3, "baseline/gp/ahead_error_db": 0.1}) == [
        "gsparc is 0.30 ± 0.10 (standard error) dB better over 24 test rows "
        "in rmse_db than gp, the best baseline"
    ]


def test_a_report_of_an_installed_wheel_was_made_at_commit_none():
    assert re.fullmatch(r"gsparc \d+\.\d+\.\d+", program_version({"git": None}))
    assert program_version({"git": "c0ffee00" * 5}).endswith(" at commit c0ffee00")


def test_headings_were_broken_inside_words_and_columns_of_dashes_shown():
    facts = {
        "dataset/kind": "csi",
        "test/nmse": 0.026,
        "test/snr_db": 18.7,
        "test/reduced_chi2": 0.6,
    }
    facts |= {
        "baseline/complex_gp/nmse": 0.9,
        "baseline/complex_gp/train_s": 7.79e-05,
        "time/train_s": 9.0,
    }
    shown = {}
    for width in (200, 60):
        console = Console(width=width, record=True, soft_wrap=True, file=open(os.devnull, "w"))  # noqa: SIM115
        console.print(results_table(facts, "gsparc"))
        shown[width] = console.export_text()
    assert "reduced_chi2" in shown[200] and max(map(len, shown[60].splitlines())) < 60
    for word in ("complex_gp", "reduced_", "chi2", "s/fold", "7.79e-05"):
        assert word in shown[60]
    assert "skill" not in shown[200] and "scalar" not in shown[60]


@pytest.mark.parametrize(
    ("label", "learned", "said"),
    [
        (
            "own",
            "ridge 0.001\nrows 9",
            ["own: ridge 0.001", "  rows 9"],
        ),  # it stood without its name
        ("gp", "AP0: gp: length 3 m", ["gp: AP0: length 3 m"]),
    ],
)
def test_the_name_of_a_method_stood_twice_before_what_it_learned(label, learned, said):
    facts = {
        "model/made": None,
        "model/label": label,
        "model/name": label,
        "model/learned": learned,
    }
    assert describe_model(facts) == said


def test_a_baseline_whose_errors_are_forty_times_its_std_had_no_remark():
    facts = {
        "dataset/kind": "rssi",
        "model/label": "gsparc",
        "test/rmse_db": 1.0,
        "test/reduced_chi2": 1.1,
    }
    (said,) = remarks(facts | {"baseline/gp/reduced_chi2": 1600.0})
    # It said `reduced_chi2 is 1 where ...` below tables without that column.
    stated = (
        "stated uncertainty: std of gp is 40 times too small (reduced_chi2 1.6e+03, 1 is right)"
    )
    assert said.startswith(stated)
