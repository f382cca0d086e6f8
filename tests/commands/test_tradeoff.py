"""`gsparc tradeoff`: a table, a picture, points kept; and loading within a budget."""

import csv
import json
import shutil

import numpy as np
import pytest
from campaigns import compose, runs_in
from refusals import refused
from towns import town_file, town_model, trained

import gsparc
from gsparc.commands.tradeoff import task
from gsparc.models import checkpoint
from gsparc.models.baselines.distance_law import DistanceLaw
from gsparc.prediction import operating_point
from gsparc.runs.experiment.tradeoff import why_irreducible
from gsparc.training import tracking


@pytest.fixture(scope="module")
def swept(field, tmp_path_factory):
    folder = tmp_path_factory.mktemp("swept")
    ckpt = folder / "model.ckpt"
    shutil.copy(field.checkpoints[0], ckpt)
    config = compose(
        f"ckpt='{ckpt}'",
        "threads=[1]",
        "rounds=5",
        "grid.stride=[1,2]",
        "baselines=[mean,distance_law]",
        config="tradeoff",
    )
    with pytest.MonkeyPatch.context() as patch:
        runs_in(patch, folder)
        said: list[tuple] = []
        patch.setattr(
            tracking, "log_table", lambda loggers, *table: said.append((len(loggers), *table))
        )
        config.logger = {"any": {"_target_": "lightning.pytorch.loggers.logger.DummyLogger"}}
        facts = task(config)
        monkey = {"in_multirun": lambda: True, "_swept": None}  # which is not called
        with pytest.MonkeyPatch.context() as second:
            for name, value in monkey.items():
                second.setattr(f"gsparc.commands.tradeoff.{name}", value)
            assert task(config) == facts, (
                "a job of a multirun is done once, though the front is in its ckpt"
            )
        return facts, folder, ckpt, said


def test_it_leaves_a_table_a_picture_and_a_summary(swept):
    facts, folder, *_ = swept
    with (folder / "tradeoff.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == facts["tradeoff/points"] == 3  # as trained, 2 without confidence
    # Fewer pixels are not as near as the full model
    assert len({row["closeness_db"] for row in rows}) == 2
    times = [float(row["render_ms_p50"]) for row in rows]
    assert times == sorted(times)
    assert all(float(row["render_ms_p95"]) >= t for row, t in zip(rows, times, strict=True))
    assert sum(int(row["front"]) for row in rows) == facts["tradeoff/front"] >= 1
    full = next(row for row in rows if row["label"].startswith("as trained"))
    assert float(full["psnr_db"]) == facts["test/psnr_db"]
    assert (folder / "tradeoff.png").stat().st_size > 20_000
    stored_facts = json.loads((folder / "summary.json").read_text())
    assert stored_facts["baseline/mean/render_ms_p50"] > 0
    assert stored_facts["time/copy_ms"] > 0 and stored_facts["machine/load"] is not None


def test_a_baseline_that_does_not_serve_the_data_ended_the_trade_off(swept):
    beside = {name.split("/")[1] for name in swept[0] if name.startswith("baseline/")}
    assert beside == {"mean"}  # laws of distance are of powers


def test_a_budget_picks_the_most_accurate_that_fits(swept, monkeypatch):
    _, _, ckpt, _ = swept
    points, _ = operating_point.stored_points(checkpoint.read(ckpt).extra)
    pretended = {i: np.full(8, 1.0 + i) for i in range(len(points))}
    monkeypatch.setattr(
        operating_point, "time_interleaved", lambda calls, clock, threads: pretended
    )
    best = max(points, key=lambda p: p.score)
    assert gsparc.load(ckpt, budget_ms=1e6).point == best
    assert gsparc.load(ckpt, budget_ms=1.5).point == points[0]
    refused(
        r"budget_ms=0.5: no operating point .* fastest .* takes 1 ms",
        gsparc.load,
        ckpt,
        budget_ms=0.5,
    )


def test_a_model_never_swept_says_what_to_do(field):
    with pytest.raises(ValueError, match=r"no operating point .* `gsparc tradeoff ckpt="):
        gsparc.load(field.checkpoints[0], budget_ms=1e-6)
    refused("a positive number of milliseconds", gsparc.load, field.checkpoints[0], budget_ms=-1)


def test_a_model_that_cannot_be_reduced_showed_one_point_without_a_word():
    whole = gsparc.load(town_model())
    method, single = whole.method, whole.select_station("west").method
    assert "of several stations is asked as it was trained" in why_irreducible(method)[0]
    assert "no Gaussians, sources" in why_irreducible(DistanceLaw())[0] and not why_irreducible(
        single
    )


def test_a_model_of_several_stations_could_not_be_timed():
    ask = gsparc.load(town_model()).cycle_places(np.array([[10.0, 20.0, 1.5], [30.0, 20.0, 1.5]]))
    assert np.isfinite(ask(0)) and ask(1) != ask(2)


def test_a_model_of_two_moving_ends_could_not_be_timed():
    draw = np.random.default_rng(0)
    tx, rx = (draw.uniform(0, 9, (40, 3)) for _ in range(2))
    predictor = gsparc.fit(
        tx=tx, rx=rx, rssi=-40 - 20 * np.log10(np.linalg.norm(tx - rx, axis=1)), model="mean"
    )
    ask = predictor.cycle_places(np.c_[tx, rx] - np.tile(predictor.site.origin, 2))
    assert np.isfinite(ask(0)).all()


@pytest.mark.slow
def test_silent_rows_did_not_count_beside_other_methods(tmp_path, monkeypatch):
    """Inverse distances, of heard rows alone, had 2.4 dB beside 2.8; of all rows they have more."""
    file = town_file(tmp_path / "town.npz", 200)
    with np.load(file) as stored:
        arrays = dict(stored)
    level = np.quantile(arrays["rssi_db"], 0.4)
    arrays["rssi_db"] = np.where(arrays["rssi_db"] < level, np.nan, arrays["rssi_db"])[:, :1]
    arrays |= {"station_position": arrays["station_position"][:1], "station_name": ["west"]}
    np.savez(file, **arrays, sensitivity_db=level)
    path = trained(file, "gp", "threads=1")
    runs_in(monkeypatch, tmp_path)
    facts = task(
        compose(f"ckpt='{path}'", "threads=[1]", "rounds=3", "baselines=[idw]", config="tradeoff")
    )
    assert (
        facts["tradeoff/figure"] == "rmse_db_with_silent"
        and facts["tradeoff/front_beaten_by_others"] == 0
    )
