"""One more station goes where the others do not serve,
by models that know stations they never heard.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from towns import MASTS, town_file, town_model

import gsparc
from gsparc.apps.maps.covered import covered_share_interval
from gsparc.apps.maps.geojson import draws_shapes
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.placing import (
    NewAntenna,
    NewStationError,
    describe_new_station,
    lay_candidates,
    new_station_error,
    place_station,
)
from gsparc.apps.maps.promise import Promise
from gsparc.base.errors import DataError
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.left_out import HeldOutLevels, Learned, held_out_levels
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import load_own
from gsparc.training.context import FitContext


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    folder: Path = tmp_path_factory.mktemp("together")
    data = load_own(town_file(folder / "town.npz"))
    method, rows = wrap_per_station(method_class("distance_law")(), data), np.arange(len(data))
    method.fit(data, Fold(rows, rows[:0], rows[:1]), FitContext(folder, stations="together"))
    checkpoint.save(folder / "model.ckpt", method)
    return method, data, folder / "model.ckpt"


@pytest.fixture(scope="module")
def promise(together):
    method, data, _ = together
    rows, out = np.arange(len(data)), data.place % 2 == 1
    evidence = held_out_levels(method, data, Fold(rows[~out], rows[:0], rows[out]), rows[out])
    return Promise(evidence, data.moving, data.station.astype(np.int64), 10.0)


def test_the_best_place_is_far_from_those_that_serve(together, promise):
    how = {"threshold_db": -75.0, "promise": promise, "count": 60}
    found = place_station(gsparc.load(together[2]), **how, error=NewStationError(3.0, 1.0, 4))
    apart = np.linalg.norm(found.places[0, :2] - MASTS[:, :2], axis=1)
    assert apart.min() > 20 and found.coverage[0] > found.before
    assert found.nearest_m[0] == pytest.approx(apart.min())
    low, high, gain_low, gain_high = found.between.T
    assert (low <= found.coverage + 0.05).all() and (found.coverage <= high + 0.05).all()
    assert (gain_low <= found.gain).all() and (found.gain <= gain_high + 0.01).all()
    assert found.gain == pytest.approx(found.coverage - found.before)
    assert (np.diff(found.coverage) <= 1e-12).all() and (found.places[:, 2] == 8).all()


def test_candidates_lay_on_diagonal_stripes(together):
    """Every n-th of flattened squares: thin along one side alone."""
    _, places, _ = lay_candidates(gsparc.load(together[2]), count=48)
    across, up = (np.unique(places[:, axis]) for axis in (0, 1))
    assert len(places) == len(across) * len(up) and 40 <= len(places) <= 56
    assert np.diff(across) == pytest.approx(np.diff(up)[0])


def test_the_share_as_it_is_was_taken_as_exact(together, promise):
    """Of a new station without error the interval had no width;
    old and new share are now drawn together.
    """
    predictor, how = gsparc.load(together[2]), {"threshold_db": -75.0, "promise": promise}
    found = place_station(predictor, **how, count=4, error=NewStationError(0.0, 1e-3, 4))
    left, right, low, high = found.grid.extent
    square = {"height_m": found.grid.height, "step_m": found.grid.step}
    field = predict_map(predictor, [left, low, right, high], **square, **how)
    now = covered_share_interval(field, predictor, promise)
    width, gained = (np.ptp(part, axis=1) for part in np.split(found.between, 2, axis=1))
    assert (width > 0.02).all() and (width < 1.1 * np.ptp(now)).all() and (gained > 0).all()


def test_any_fault_of_a_covariance_was_taken_for_a_model_without_one(
    together, promise, monkeypatch
):
    predictor = gsparc.load(together[2])
    monkeypatch.setattr(
        Predictor, "covariance", lambda *_, **__: pytest.fail("nothing is asked and dropped")
    )
    field = predict_map(predictor, step_m=4.0, threshold_db=-75.0, promise=promise)
    low, high = covered_share_interval(field, predictor, promise)
    assert low < 1 - np.nanmean(field.outage) < high


def test_an_interval_of_no_width_stood_where_no_station_was_left_out(together):
    found = place_station(gsparc.load(together[2]), threshold_db=-75.0, count=4)
    assert np.isnan(found.between).all() and np.isfinite(found.gain).all()


def test_sectors_left_out_one_by_one_were_told_by_others_of_their_site(together, monkeypatch):
    """And of lists the strong rows alone counted: 5.3 dB off in a network,
    1.9 dB with silent rows.
    """
    method, data, _ = together
    stations, rows = data.site.stations, np.arange(len(data))
    four = replace(stations, position=np.repeat(stations.position, 2, 0), name=(*"abcd",))
    data = replace(data, site=replace(data.site, stations=four), station=rows % 4)
    left, rng = [], np.random.default_rng(0)

    def evidence(learned, fold, block):
        left.append(set(data.station[fold.test].tolist()))
        error, nothing = rng.normal(0, 6, 2000), np.zeros(2000)
        heard = error > 3  # the others are below a level that a list ends with
        side, level = (~heard).astype(np.int8), np.where(heard, error, 3.0)
        return HeldOutLevels(level, nothing, nothing + 6, nothing, nothing, nothing, side)

    monkeypatch.setattr("gsparc.apps.maps.placing.unlearn_and_predict", evidence)
    monkeypatch.setattr("gsparc.apps.maps.placing.LEAST_STATIONS", 2)
    fold = Fold(rows, rows[:0], rows[:1])
    found = new_station_error(
        Learned(method, method_class("distance_law"), data, fold, FitContext())
    )
    assert sorted(map(sorted, left)) == [[0, 1], [2, 3]] and found.stations == 2
    assert found.offset_db < 4  # 8 of those heard


def test_intervals_took_four_stations_for_very_many(together, promise):
    """Of halls' stations really left out, intervals of 90 %
    by the normal's 1.645 held 56 to 86 %.
    """
    predictor, how = (
        gsparc.load(together[2]),
        {"threshold_db": -75.0, "count": 4, "promise": promise},
    )
    few, many = (
        place_station(predictor, **how, error=NewStationError(3.0, 1.0, stations))
        for stations in (4, 10_000)
    )
    assert (np.ptp(few.between[:, 2:], 1) > np.ptp(many.between[:, 2:], 1)).all()
    assert many.coverage == pytest.approx(few.coverage, abs=0.02)


def test_refused_squares_counted_as_not_served(together):
    method, data, path = together
    rows, west = np.arange(len(data)), data.station == 0
    out = data.place % 2 == 1
    evidence = held_out_levels(method, data, Fold(rows[~out], rows[:0], rows[out]), rows[out])
    promise = Promise(evidence, data.moving[west], data.station[west].astype(np.int64), 10.0)
    how = {"threshold_db": -75.0, "promise": promise}
    found = place_station(gsparc.load(path), [-80, 0, 80, 60], count=9, **how)
    left, right, low, high = found.grid.extent
    square = {"height_m": found.grid.height, "step_m": found.grid.step}
    field = predict_map(gsparc.load(path), [left, low, right, high], **square, **how)
    assert found.refused == pytest.approx(field.refused.mean()) and 0.4 < found.refused < 0.6
    assert found.before == pytest.approx(1 - np.nanmean(field.outage))
    assert found.places[0, 0] > 0  # not where nothing was tested


def test_candidates_are_a_table_and_power_is_given(together, tmp_path):
    (tmp_path / "roofs.csv").write_text("name,x,y,z\nA,5,5,20\nB,75,5,12\n")
    predictor, how = (
        gsparc.load(together[2]),
        {"threshold_db": -75.0, "sites": tmp_path / "roofs.csv"},
    )
    found = place_station(predictor, **how)
    named = dict(zip(found.given["name"].tolist(), found.places.tolist(), strict=True))
    assert named == {"A": [5, 5, 20], "B": [75, 5, 12]}
    louder = place_station(predictor, **how, antenna=NewAntenna(power_db=10))
    assert louder.coverage[0] > found.coverage[0] + 0.05
    with pytest.raises(DataError, match="knows no patterns"):
        place_station(predictor, **how, antenna=NewAntenna(azimuth=[0, 120]))
    with pytest.raises(DataError, match="degrees from north"):
        place_station(predictor, **how, antenna=NewAntenna(azimuth="north"))


def test_polygons_of_candidates_were_read_as_a_table(together, tmp_path):
    square = {"type": "Polygon", "coordinates": [[[0, 0], [60, 0], [60, 20], [0, 20], [0, 0]]]}
    points = {"type": "MultiPoint", "coordinates": [[5, 5, 20], [75, 5, 12]]}
    named = {
        "type": "Feature",
        "geometry": points,
        "properties": {"shape": "Polygon"},
    }  # once looked for as text
    predictor, found = gsparc.load(together[2]), []
    for number, content in enumerate((square, points, named)):
        (tmp_path / f"{number}.geojson").write_text(json.dumps(content))
        found.append(draws_shapes(tmp_path / f"{number}.geojson"))
    assert found == [True, False, False]
    inside = place_station(
        predictor, threshold_db=-75.0, sites=tmp_path / "0.geojson", count=4
    ).places
    assert len(inside) > 1 and (inside[:, :2] >= 0).all() and (inside[:, :2] <= [60, 20]).all()


def test_two_stations_leave_none_out(together):
    method, data, _ = together
    rows = np.arange(len(data))
    fold = Fold(rows, rows[:0], rows[:1])
    learned = Learned(method, method_class("distance_law"), data, fold, FitContext())
    assert new_station_error(learned).stations == 0


def test_a_new_station_among_bands_was_put_in_one_that_nobody_named(together):
    site = gsparc.load(together[2]).site
    assert "band" not in describe_new_station(site, 8.0, NewAntenna())
    two = replace(site, stations=replace(site.stations, carrier_hz=np.array([2.6e9, 1.8e9])))
    assert describe_new_station(two, 8.0, NewAntenna([0, 120])).startswith(
        "assumed: 8 m high in the band of 1800 MHz, sect"
    )
    named = NewAntenna(carrier_hz=2.65e9)  # within a tenth of 2.6 GHz
    assert named.find_alike(two.stations) == 0 and NewAntenna().find_alike(two.stations) is None
    assert "in the band of 2650 MHz" in describe_new_station(two, 8.0, named)
    refused(
        "no station's band; there are 1800, 2600 MHz",
        NewAntenna(carrier_hz=8e8).find_alike,
        two.stations,
    )
    known = replace(site, stations=replace(site.stations, carrier_hz=np.array([2.6e9, 2.6e9])))
    assert NewAntenna(carrier_hz=2.6e9).find_alike(known.stations) is None


def test_a_station_of_no_known_height_was_nan():
    """`position= holds NaN` where the places of all stations were estimated from powers."""
    predictor = gsparc.load(town_model())
    stations = predictor.site.stations
    lost = replace(stations, position=np.full_like(stations.position, np.nan))
    predictor.site = replace(predictor.site, stations=lost)
    with pytest.raises(
        DataError, match="no station's height is known; say station_height_m=METRES"
    ):
        place_station(predictor)
