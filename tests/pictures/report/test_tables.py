"""Tables say what the runs left, with intervals that cover and times beside."""

import csv
import io
import json

import numpy as np
import pytest
from rich.console import Console

from gsparc.evaluation.paired import lead_over_runs
from gsparc.evaluation.results import Run, frame, frame_of_runs, own_rows, short_settings
from gsparc.evaluation.table import Column, Interval, Table
from gsparc.pictures.report import tables
from gsparc.pictures.report.page import warnings
from gsparc.pictures.report.tables import bootstrap_interval


def cells(table, row: int) -> dict:
    return dict(zip([c.name for c in table.columns], table.rows[row], strict=True))


@pytest.mark.parametrize(
    ("folder", "text", "message"),
    [
        ("absent", None, "absent: no such directory"),
        ("empty", None, "empty: no run in it"),
        ("damaged", "{", "summary.json: cannot be read as a summary"),
    ],
)
def test_a_directory_without_a_run_is_named(folder, text, message, tmp_path):
    if folder != "absent":
        (tmp_path / folder).mkdir()
    if text is not None:
        (tmp_path / folder / "summary.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        frame(tmp_path / folder)


def test_results_have_accuracy_beside_time_memory_and_origin(three):
    table = tables.table_of_results(frame(*three))
    row = cells(table, 0)
    assert row["PSNR dB"].value == 28.0 and row["PSNR dB"].low < 28.0 < row["PSNR dB"].high
    assert row["train s/fold"] == 10 and row["query ms p50"] == 0.5 and row["memory MB"] == 800
    assert row["Gaussians"] == 500 and row["effects"] == "none" and row["data"] == "d" * 8
    assert row["commit"] == "c" * 8 and row["s simulated"] is None
    assert cells(table, 2)["points measured"] == 60
    named = [r[0] for r in table.rows]
    assert (
        named[3:] == ["mean (baseline)", "gp (baseline)"] and cells(table, 4)["query ms p50"] == 0.7
    )


def test_seeds_are_put_together_with_their_spread(three):
    table = tables.table_of_seeds(frame(*three))
    found = cells(table, 0)["PSNR dB"]
    assert (found.value, found.low, found.high) == (pytest.approx(28.2), 28.0, 28.4)
    assert cells(table, 0)["seeds"] == 2 and cells(table, 1)["PSNR dB"] == Interval(29.5)


def test_an_interval_covers_as_often_as_it_says():
    draw = np.random.default_rng(0)
    hits = 0
    for _ in range(100):
        low, high = bootstrap_interval(draw.normal(5, 2, 40))
        hits += low < 5 < high
    assert 86 <= hits <= 100


def test_the_worst_receivers_are_the_worst(three):
    runs = frame(three[0])
    samples = runs.run[0].samples
    table = tables.table_of_worst(runs)
    values = [row[4] for row in table.rows]
    assert values == sorted(samples["psnr_db"])[:3]
    # The Gaussian process at the same place
    assert table.rows[0][5] == pytest.approx(values[0] - 0.5)
    del samples["baseline/gp/psnr_db"]  # powers have no such column: it was left empty
    assert "gp there" not in [column.name for column in tables.table_of_worst(runs).columns]


def test_a_table_survives_csv_and_markdown():
    lines = [["a|b", Interval(1.25, 1.0, 2.0), 3], ["c", None, None]]
    table = Table("T", [Column("name"), Column("x", ".1f"), Column("n", "d")], lines, "note")
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    assert rows[0] == {"name": "a|b", "x": "1.25", "x low": "1.0", "x high": "2.0", "n": "3"}
    assert rows[1]["x"] == ""
    text = table.markdown()
    assert "| a\\|b | 1.2 [1.0, 2.0] | 3 |" in text and "| c | - | - |" in text and "note" in text


def test_latency_measured_alone_wins_over_the_one_of_the_sweep(three):
    (three[0] / "render_ms.csv").write_text("render_ms\n0.1\n0.1\n0.3\n")
    assert list(own_rows(frame(*three[:2])).query_ms) == [0.1, 0.5]
    assert json.loads((three[0] / "summary.json").read_text())["time/render_ms_p50"] == 0.5


def test_labels_of_sweeps_lost_true_and_false_on_the_console():
    settings = [f"gsparc-paper model.attenuation.inverse_distance={on}" for on in (True, False)]
    columns = [Column("method and setting", ""), *(Column(f"figure {n} dB") for n in range(8))]
    console = Console(width=100, record=True, file=io.StringIO(), soft_wrap=True)
    console.print(Table("", columns, [[one, *[Interval(1.0, 0.5, 1.5)] * 8] for one in settings]))
    first = "".join(
        line.split("│")[1].strip() for line in console.export_text().splitlines() if "│" in line
    )
    assert all(one.replace(" ", "") in first.replace(" ", "") for one in settings)


def test_settings_of_several_models_were_told_for_each(tmp_path):
    kinds = ({"model._target_": "a.A", "model.x": 1}, {"model._target_": "b.B", "model.y": 2})
    runs = [
        Run(tmp_path, {"model/name": str(i)}, config={**kind, "init.count": i})
        for i, kind in enumerate(kinds)
    ]
    told = "".join(tables.differing_settings(frame_of_runs(runs)).values())
    assert "init.count=1" in told and "model.x" not in told and "model._target_" not in told


def test_a_report_of_lists_left_out_the_figure_that_decides(tmp_path):
    """Beside its table of listed rows a remark named the better baseline by all rows."""
    figures = {"rmse_db": 4.6, "mae_db": 3.0, "rmse_db_with_silent": 2.2}
    run = Run(
        tmp_path, {"dataset/kind": "rssi", **{f"test/{name}": v for name, v in figures.items()}}
    )
    shown = cells(tables.table_of_results(frame_of_runs([run])), 0)
    assert list(shown)[2:5] == ["RMSE dB, silent too", "RMSE dB", "MAE dB"]
    assert shown["RMSE dB, silent too"].value == 2.2


def test_draws_of_a_split_were_settings_beside_the_baselines_of_the_first(run_dir, tmp_path):
    """One row of gp, of draw 0, stood beside three of gsparc;
    nothing was pooled over `split.seed`.
    """
    for draw, (own, gp) in enumerate([(29.0, 28.9), (28.0, 28.2), (30.0, 29.4)]):
        folder = run_dir(
            tmp_path / str(draw), psnr=own, overrides=("dataset=rfid", f"split.seed={draw}")
        )
        facts = json.loads((folder / "summary.json").read_text())
        facts |= {"split/sha256": f"{draw}" * 64, "baseline/gp/psnr_db": gp}
        (folder / "summary.json").write_text(json.dumps(facts))
    runs = short_settings(frame(tmp_path))
    pooled = tables.table_of_seeds(runs)
    assert pooled.title == "Settings over draws"
    assert [row[0] for row in pooled.rows] == ["gsparc", "mean (baseline)", "gp (baseline)"]
    found = cells(pooled, 0)
    assert (found["draws"], found["seeds"]) == (3, 1)
    assert found["PSNR dB"] == Interval(29.0, error=pytest.approx(1 / 3**0.5))
    assert cells(pooled, 2)["PSNR dB"].value == pytest.approx(28.8333, abs=1e-4)
    assert "PSNR dB error" in pooled.csv() and "least" not in pooled.csv()
    ahead = cells(tables.table_of_leads(runs), 1)
    gains = np.array([0.1, -0.2, 0.6])
    assert (ahead["against"], ahead["pairs"], ahead["significant"]) == ("gp", "3 draws", "no")
    assert ahead["ahead of it, dB"].value == pytest.approx(gains.mean())
    assert ahead["ahead of it, dB"].error == pytest.approx(gains.std(ddof=1) / 3**0.5)
    results = tables.table_of_results(runs)
    assert [row[0] for row in results.rows].count("gp (baseline)") == 3
    assert warnings(runs) == [
        "the baseline gp and gsparc do not differ significantly in psnr_db: "
        "gsparc is 0.17 ± 0.23 (standard error) dB better over 3 draws"
    ]


def test_copies_of_one_split_counted_as_draws(run_dir, tmp_path):
    """`split.seed` moved validation rows alone where a release names the test rows:
    ± 0.00 over 3 draws.
    """
    for draw in range(3):
        file = run_dir(tmp_path / str(draw), overrides=(f"split.seed={draw}",)) / "summary.json"
        facts = json.loads(file.read_text()) | {
            "split/sha256": f"{draw}" * 64,
            "split/test_sha256": "t",
        }
        file.write_text(json.dumps(facts))
    runs = short_settings(frame(tmp_path))
    pooled = tables.table_of_seeds(runs)
    assert pooled.title == "Settings over seeds" and "split.redraw=true" in pooled.note
    assert cells(pooled, 0)["seeds"] == 3 and cells(pooled, 0)["PSNR dB"].error is None
    assert all("draws" not in row[3] for row in tables.table_of_leads(runs).rows)
    assert lead_over_runs(*([row] for row in own_rows(runs)[:2].to_dict("records"))) is None, (
        "they learned from other rows"
    )


def test_a_sweep_of_seeds_did_not_say_that_the_split_is_one(three):
    assert (
        "on the same test rows: split.seed draws others"
        in tables.table_of_seeds(frame(*three)).note
    )


def test_one_model_had_two_latencies_and_a_note_in_the_report_alone(three):
    runs = frame(*three)
    notes = [tables.table_of_seeds(runs).note, tables.table_of_results(runs).note]
    assert all("a run's own table has other milliseconds" in note for note in notes)


def sweep_of(run_dir, folder, levels):
    """Runs of two settings, on and off, with a seed for each pair of levels [dB]."""
    for seed, pair in enumerate(levels):
        for word, level in zip(("on", "off"), pair, strict=True):
            run_dir(
                folder / f"{word}{seed}",
                seed=seed,
                psnr=level,
                overrides=(f"x={word}", f"seed={seed}"),
            )
    return short_settings(frame(folder))


def test_an_ablation_by_multirun_had_no_paired_difference(run_dir, tmp_path):
    """Two means with their least and largest stood side by side;
    the rows and seeds of both are the same.
    """
    (lead,) = tables.table_of_leads(
        sweep_of(run_dir, tmp_path / "a", [(29.0, 28.7), (30.0, 29.9)])
    ).rows
    first, other = lead[1], lead[0]
    assert (other, first) == ("gsparc x=on", "gsparc x=off") and lead[3:] == ["2 seeds", "no"]
    assert lead[2].value == pytest.approx(0.2) and lead[2].error == pytest.approx(0.1)
    assert (
        "| gsparc x=on | gsparc x=off | 0.20 ± 0.10 | 2 seeds | no |"
        in tables.table_of_leads(frame(tmp_path / "a")).markdown()
    )


def test_settings_were_told_apart_without_a_word_on_the_seed_that_they_share(run_dir, tmp_path):
    said = "Of one seed: what seeds change is not in the error"
    for seeds in (1, 2):
        runs = sweep_of(run_dir, tmp_path / str(seeds), [(29.0, 28.7)] * seeds)
        assert (said in tables.table_of_leads(runs).markdown()) == (seeds == 1)
