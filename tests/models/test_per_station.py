"""A copy of a method for each station, and one for stations that were never heard."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from posts import POSTS, distances, free_space, heard, walked
from refusals import refused
from scenes import fold_of

import gsparc
from gsparc.data.query import Query
from gsparc.data.splits import Fold, Split
from gsparc.datasets.load import split_for
from gsparc.evaluation.scores import score_methods
from gsparc.models import checkpoint, loading, per_station
from gsparc.models.fitting import fit_or_resume
from gsparc.models.per_station import PerStation, wrap_per_station
from gsparc.models.registry import method_class
from gsparc.models.station_sites import station_site, stations_of_fold
from gsparc.prediction.timing import ClockSettings
from gsparc.runs.baselines import baselines_for
from gsparc.runs.evaluate import evaluate
from gsparc.runs.experiment.folds import fit_folds, fold_contexts
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


@pytest.fixture(scope="module")
def town():
    """Free space and a constant for each of four stations, which are not calibrated."""
    return heard(120, rssi_db=lambda far: free_space(far) - [0, 10, 20, 30])


def fitted(name, data, fold, folder=Path()):
    method = wrap_per_station(method_class(name)(), data)
    method.fit(data, fold, FitContext(folder))
    return method


@pytest.fixture(scope="module")
def fold(town):
    return fold_of(town)


def test_every_station_has_its_own(town, fold, tmp_path):
    method = fitted("mean", town, fold, tmp_path)
    assert isinstance(method, PerStation)
    found = method.predict(town.batch(fold.test)).mean[:, 0]
    for number in range(len(POSTS)):
        rows = fold.test[town.station[fold.test] == number]
        alone = town.subset(np.flatnonzero(town.station == number), station_site(town.site, number))
        assert alone.site.static_position is not None
        assert len(found[town.station[fold.test] == number].unique()) == 1, rows
    decibels = 10 * torch.log10(found)
    assert decibels.max() - decibels.min() > 25


def test_stations_are_found_by_their_places_too(town, fold, tmp_path):
    method = fitted("idw", town, fold, tmp_path)
    batch = town.batch(fold.test[::7])
    assert torch.equal(method.predict(Query(batch.tx, batch.rx)).mean, method.predict(batch).mean)


def test_checkpoints_hold_all_copies(town, fold, tmp_path):
    method = fitted("gp", town, fold, tmp_path)
    checkpoint.save(tmp_path / "m.ckpt", method)
    again, stored = loading.load(tmp_path / "m.ckpt")
    assert stored.site.stations.name == town.site.stations.name
    batch = town.batch(fold.test)
    assert torch.equal(again.predict(batch).mean, method.predict(batch).mean)
    predictor = gsparc.load(tmp_path / "m.ckpt")
    place = town.tx[fold.test[0]] + town.site.origin
    number = int(town.station[fold.test[0]])
    one = predictor.select_station(number).rssi(tx=place, unit="linear")
    assert one == pytest.approx(
        float(method.predict(town.batch(fold.test[:1])).mean) * town.site.target_scale
    )
    assert predictor.rssi(tx=place, unit="linear")[number] == one
    sure = predictor.confidence(tx=place)
    assert sure[number] == predictor.select_station(number).confidence(tx=place)
    refused("no station 'roof'; there are 0, 1", predictor.select_station, "roof")


def test_a_station_never_heard_is_asked_with_both_ends_and_its_constant_may_be_taken_away(
    town, tmp_path
):
    split = split_for({"name": "stations"}, town)
    contexts = fold_contexts(FitContext(tmp_path), split)
    fits = fit_folds(method_class("mean")(), town, split, contexts)
    found = evaluate(
        fits.methods,
        None,
        town,
        split,
        baselines=["zero"],
        clock=ClockSettings(rounds=1, least=1),
    ).facts
    spread = np.std(10 * np.log10(town.target[:, 0]).reshape(-1, 4), axis=0)
    assert found["test/rmse_db_after_constant"] == pytest.approx(
        np.sqrt(np.mean(spread**2)), rel=0.01
    )
    assert found["test/rmse_db"] > max(10, 2 * found["test/rmse_db_after_constant"])
    gsparc_like = type("OneEnd", (method_class("mean"),), {"both_ends": False})
    with pytest.raises(ValueError, match="cannot predict stations that it never heard"):
        fits = fit_folds(gsparc_like(), town, split, contexts)
        score_methods(fits.methods, town, split)


def test_both_ends_moving_is_refused_by_whoever_knows_one(tmp_path):
    walk = walked(40)
    data = from_arrays({"tx_position": walk, "rx_position": walk[::-1] + 1, "rssi_db": -walk[:, 0]})
    assert wrap_per_station(method_class("idw")(), data).both_ends
    refused("both ends move here", wrap_per_station, method_class("array")(), data)


def test_a_station_that_heard_nothing_ended_the_run():
    """Methods that learn from what was heard alone found an empty training set there."""
    data = heard(rssi_db=lambda far: free_space(far) - [40, 40, np.nan, 40], sensitivity_db=-80.0)
    fold = fold_of(data)
    for name in ("nearest", "kriging", "gp"):
        assert fitted(name, data, fold).predict(data.batch(fold.test)).mean.isfinite().all()


def test_rows_where_nothing_was_heard_did_not_count_for_gsparc():
    """It learns from them, as the processes do that it is compared with,
    of which a station had none.
    """
    data = heard(rssi_db=lambda far: free_space(far) - [40, 40, np.nan, 40], sensitivity_db=-80.0)
    for name in ("gsparc", "powers", "gp"):
        assert stations_of_fold(method_class(name)(), data, fold_of(data)).learnable.all()
    context = FitContext(stations="each", effort=0.1)
    method, _ = fit_or_resume(
        wrap_per_station(method_class("gsparc")(), data), data, fold_of(data), context
    )
    assert method.predict(data.batch(fold_of(data).test)).mean.isfinite().all()


def test_sectors_of_one_mast_were_answered_by_the_first():
    """A position does not say which of two stations there is meant:
    the first one answered for both.
    """
    named = np.array(["sector 1", "sector 2"])
    data = heard(
        posts=POSTS[[0, 0]],
        rssi_db=lambda far: walked()[:, :2] * [-1, -1] - [0, 30],
        station_name=named,
    )
    fold = fold_of(data)
    method, batch = fitted("idw", data, fold), data.batch(fold.test)
    found = 10 * method.predict(batch).mean.log10()[:, 0]
    assert (found[batch.station == 0] - found[batch.station == 1]).min() > 5
    refused("sector 1 and sector 2 stand at one place", method.predict, Query(batch.tx, batch.rx))


def test_the_place_of_a_single_station_was_sought():
    """A table of one station, or the one that `dataset.stations` keeps, had no place."""
    for end in ("tx", "rx"):
        data = heard(posts=POSTS[1:2], end=end)
        np.testing.assert_allclose(data.site.static_position + data.site.origin, POSTS[1])
        fold, method = fold_of(data), wrap_per_station(method_class("distance_law")(), data)
        notes = method.fit(data, fold, FitContext()).notes
        assert len(notes) == 1 and "exponent 2" in notes[0]
        assert data.batch(fold.test).rx.batched == (end == "rx")


def test_a_baseline_that_cannot_ended_the_run_of_a_station_with_few_rows():
    """`complex_gp` knows one end that stands still:
    it is left out where a station taught nothing.
    """
    csi = np.exp(-2j * np.pi * distances(60, POSTS[:2]))
    mask = np.ones(csi.shape, bool)
    mask[3:, 1] = False
    data = heard(posts=POSTS[:2], csi=csi, mask=mask, frequency_hz=3e8)
    folds = [
        Fold(np.setdiff1d(np.arange(len(data)), rows), np.zeros(0, int), np.array(rows))
        for rows in ([0, 4, 6], [1, 4, 6])
    ]
    kept = [baselines_for(data, Split("random", (fold,))) for fold in folds]
    assert ["complex_gp" in names for names in kept] == [True, False]


def test_chunks_of_many_stations_asked_every_model(town, fold, tmp_path, monkeypatch):
    """A file of 50,000 rows at 12 stations read 12 large matrices for every 64 rows:
    half an hour.
    """
    method = fitted("gp", town, fold, tmp_path)
    whole = score_methods([method], town, Split("random", (fold,)))
    asked = []
    monkeypatch.setattr("gsparc.evaluation.scores.CHUNK", 6)
    answer = method.predict
    monkeypatch.setattr(
        method, "predict", lambda b: asked.append(len(b.station.unique())) or answer(b)
    )
    parts = score_methods([method], town, Split("random", (fold,)))
    assert sum(asked) < len(asked) + len(POSTS)
    np.testing.assert_array_equal(parts.row, whole.row)
    for name in whole.samples:
        np.testing.assert_allclose(parts.samples[name], whole.samples[name], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(parts.variance, whole.variance, rtol=1e-4)


def test_seconds_of_stations_were_said_to_be_unused(town):
    assert wrap_per_station(method_class("gsparc")(), town).takes_effort
    assert not wrap_per_station(method_class("idw")(), town).takes_effort


def test_a_station_at_an_unknown_place_answered_for_all(town, fold, tmp_path):
    """The distance to it was NaN, and the least of every row."""
    method = fitted("mean", town, fold, tmp_path)
    places = np.array(town.site.stations.position)
    expected = method._stations_of_query(town.batch(fold.test))
    places[1] = np.nan
    method.site = replace(town.site, stations=replace(town.site.stations, position=places))
    rows = fold.test[expected.numpy() != 1]
    assert (method._stations_of_query(town.batch(rows)) == expected[expected != 1]).all()


def test_ratios_of_a_method_were_added_over_stations():
    figures = {"model/steps": 3, "time/init_s": 0.5, "model/exponent": 2.0, "model/init": "rays"}
    combined = {
        name: per_station._combine_facts([value] * 2, name) for name, value in figures.items()
    }
    assert combined == {
        "model/steps": 6,
        "time/init_s": 1.0,
        "model/exponent": 2.0,
        "model/init": "rays",
    }
