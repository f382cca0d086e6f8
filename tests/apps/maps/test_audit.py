"""Claims of several files, draws that are repeated, and what a verdict counts."""

import json

import numpy as np
import pytest

from gsparc.apps.maps.audit import Demand, DriveRows, digest_of, judge, read_draws, sample_tours
from gsparc.apps.maps.claim import ClaimErrors, read_claim
from gsparc.apps.maps.streets import StreetGraph
from gsparc.base.errors import DataError

rasterio = pytest.importorskip("rasterio", reason="pip install 'gsparc[maps]'")
from rasterio.transform import from_origin  # noqa: E402

SERVED = Demand(-110.0, 0.95)


def write_raster(path, values, crs="EPSG:32617", **more):
    size = {"height": len(values), "width": values.shape[1], "dtype": "float32", "count": 1}
    at = from_origin(681_000, 3_984_000, 10, 10)
    with rasterio.open(path, "w", crs=crs, transform=at, nodata=-9999, **size) as file:
        file.write(values.astype(np.float32), 1)
        if "unit" in more:
            file.set_band_unit(1, more["unit"])
    return path


@pytest.fixture
def raster(tmp_path):
    """Levels that fall from west to east, two squares without one."""
    values = np.tile(np.linspace(-60, -120, 40), (30, 1))
    values[3, 4] = values[20, 11] = -9999
    return write_raster(tmp_path / "a.tif", values)


def test_squares_that_reach_the_threshold_are_claimed(raster):
    claim = read_claim(raster, -110.0)
    assert len(claim.place) == pytest.approx(33 * 30 - 2, rel=0.04)
    assert claim.level.min() >= -110 and claim.grid.step == pytest.approx(10, rel=1e-2)
    assert np.ptp(claim.place[:, 0]) < np.ptp(read_claim(raster).place[:, 0])


def test_yes_and_no_as_raster_and_as_polygons(raster, tmp_path):
    yes = np.tile(np.arange(40) < 20, (30, 1)) * 1.0
    ones = read_claim(write_raster(tmp_path / "b.tif", yes), -110.0)
    assert len(ones.place) == pytest.approx(600, abs=30) and np.isnan(ones.level).all()
    corners = [[-78.99, 35.98], [-78.98, 35.98], [-78.98, 35.99], [-78.99, 35.99], [-78.99, 35.98]]
    shape = {"type": "Polygon", "coordinates": [corners]}
    (tmp_path / "c.geojson").write_text(json.dumps(shape))
    text = "POLYGON ((" + ", ".join(f"{x} {y}" for x, y in corners) + "))"
    for claim in (tmp_path / "c.geojson", text):
        drawn = read_claim(str(claim), -110.0, None, None, 50.0)
        assert len(drawn.place) == pytest.approx(902 * 1109 / 2500, rel=0.05)


def test_squares_of_degrees_in_the_north_leave_no_gaps(tmp_path):
    size = {"height": 40, "width": 40, "dtype": "float32", "count": 1}
    at = from_origin(25.0, 68.0, 1e-3, 1e-3)  # 42 by 112 m
    with rasterio.open(tmp_path / "n.tif", "w", crs="EPSG:4326", transform=at, **size) as file:
        file.write(np.full((40, 40), -90, np.float32), 1)
    claim = read_claim(tmp_path / "n.tif", -110.0)
    assert len(claim.place) * claim.grid.step**2 == pytest.approx(1600 * 41.8 * 111.5, rel=0.03)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"threshold_db": -30.0}, "no place reaches -30, its levels are -120 to -60"),
        ({"station": "west"}, "no band west"),
        ({"area": "POLYGON ((0 0, 0.01 0, 0.01 0.01, 0 0))"}, "area|no level is known"),
    ],
)
def test_claims_that_cannot_be(raster, given, says):
    with pytest.raises(DataError, match=says):
        read_claim(raster, **given)


def test_a_raster_of_another_unit_is_refused(tmp_path):
    file = write_raster(tmp_path / "d.tif", np.full((5, 5), 3.0), unit="m")
    with pytest.raises(DataError, match="its unit is m; levels are needed"):
        read_claim(file, -110.0)


def test_rows_in_degrees_need_a_projection_of_the_claim(tmp_path, raster):
    bare = read_claim(write_raster(tmp_path / "e.tif", np.full((5, 5), -90.0), crs=None), -110.0)
    with pytest.raises(DataError, match="say the projection"):
        bare.local(np.zeros((1, 2)), read_claim(raster).grid.origin, "rows=a.csv")


@pytest.mark.parametrize("asked", [(None,), (-110.0, 0.95, (-3.0, 3.0)), (None, 0.95, (3.0, -3.0))])
def test_a_question_is_of_coverage_or_of_levels(asked):
    with pytest.raises(DataError, match="threshold_dbm=-110 share"):
        Demand(*asked)


@pytest.fixture
def drawn(raster):
    """A claim, and three tours of ten places along a street in its middle."""
    claim = read_claim(raster, -110.0)
    key = digest_of(claim, SERVED)
    doubt = np.where(claim.place[:, 0] > 0, 1.9, 0.1)
    doubt /= doubt.mean()
    return claim, *sample_tours(claim, key, doubt, 0.5, (1, 2, 3), 10, 7), key, doubt


def test_draws_are_repeated_by_their_seed_and_known_again(drawn, tmp_path):
    claim, draws, ways, key, doubt = drawn
    again, _ = sample_tours(claim, key, doubt, 0.5, (2,), 10, 7)
    second = draws[draws.tour == 2]
    assert (again.place.to_numpy() == second.place.to_numpy()).all()
    assert len(ways) == 3 and (draws.groupby("tour").stop.max() == 10).all()
    draws.to_csv(tmp_path / "draws.csv", index=False)
    assert len(read_draws(tmp_path / "draws.csv", key, claim)) == 30
    other = digest_of(claim, Demand(-110.0, 0.9))
    with pytest.raises(DataError, match="no draws of this claim"):
        read_draws(tmp_path / "draws.csv", other, claim)


def test_places_are_drawn_where_the_claim_is_in_doubt_and_weighed(drawn):
    claim, _, _, key, doubt = drawn
    many, _ = sample_tours(claim, key, doubt, 0.5, range(40), 25, 1)
    weight = 1 / (1 - many.part + many.part * many.ratio)
    east = claim.place[many.place, 0] > 0
    assert east.mean() > 0.6 and weight.max() <= 2
    even = (claim.place[:, 0] > 0).mean()
    assert np.average(east, weights=weight) == pytest.approx(even, abs=0.06)


def test_a_way_goes_along_streets(raster):
    from shapely import LineString

    claim = read_claim(raster, -110.0)
    streets = StreetGraph.from_lines([LineString([(-200, 0), (200, 0)])], 5.0)
    _, (way,) = sample_tours(claim, "", np.ones(len(claim.place)), 0.0, (1,), 5, 0, streets)
    assert len(way) >= 5


def rows_at(claim, draws, holds):
    level = np.where(holds, -100.0, -115.0)
    none = np.zeros(len(draws), int)
    return DriveRows(claim.place[draws.place], level, none, none)


def test_unreached_places_count_against_both_or_not_at_all(drawn):
    claim, draws, *_ = drawn
    first = draws[draws.tour == 1]
    some = rows_at(claim, first[:6], np.ones(6))
    _, _, table = judge(claim, draws, some, SERVED, 1.0)
    assert len(table) == 10  # of tours nobody began nothing is known
    missed = ~table.reached.to_numpy()
    assert (table.low[missed] == 0).all() and (table.high[missed] == 1).all()
    _, _, alone = judge(claim, draws, some, SERVED, 1.0, reachable_only=True)
    assert alone.stands.iloc[-1] > 1 > table.stands.iloc[-1]


def test_a_map_that_fails_everywhere_falls_at_the_end_of_a_tour(drawn):
    claim, draws, *_ = drawn
    verdict, count, _ = judge(claim, draws, rows_at(claim, draws, np.zeros(30)), SERVED, 1.0)
    assert (verdict, count) == ("falls", 10)


def test_rows_that_were_not_heard_fail_where_that_is_sure():
    level, side = np.array([-120.0, -100.0, -100.0]), np.array([1, 1, -1])
    low, high = SERVED.bounds(np.full(3, -90.0), level, side)
    assert low.tolist() == [0, 0, 1] and high.tolist() == [0, 1, 1]


def test_a_model_of_rows_states_a_share_with_its_interval(drawn):
    claim, *_ = drawn
    random = np.random.default_rng(0)
    at = claim.place[random.choice(len(claim.place), 150)]
    error = np.where(at[:, 0] > 0, 20.0, -20.0) + random.normal(0, 2, 150)
    errors = ClaimErrors.from_rows(at, error)
    margin = np.zeros(len(claim.place))
    share, low, high = errors.share(claim.place, margin)
    true = (claim.place[:, 0] <= 0).mean()
    assert low <= share <= high and abs(share - true) < 0.1 and high - low < 0.3
    chance = errors.chance_below(claim.place, margin)
    assert np.median(chance[claim.place[:, 0] > 20]) > 0.9


def test_of_best_servers_the_strongest_counts(drawn):
    claim, draws, *_ = drawn
    first = draws[draws.tour == 1]
    at, none = claim.place[first.place], np.zeros(20, int)
    level = np.repeat([-100.0, -130.0], 10)
    rows = DriveRows(np.concatenate([at, at]), level, none, np.repeat([0, 1], 10))
    _, _, table = judge(claim, draws, rows, SERVED, 1.0)
    assert (table.low == 1).all() and table.reached.all()
