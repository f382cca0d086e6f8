"""Places to measure: they fall where nobody measured, take error away, and make a short walk."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree
from towns import town_model

import gsparc
from gsparc.apps.maps.covariance import ErrorCovariance, error_covariances, weigh_goal
from gsparc.apps.maps.planning import pairs_too_near, plan_measurements
from gsparc.apps.maps.promise import Promise
from gsparc.apps.maps.streets import StreetGraph, Tour, Ways
from gsparc.models.abilities import JointLevels
from gsparc.prediction.jointly import JointMixin
from gsparc.prediction.left_out import HeldOutLevels


@pytest.fixture(scope="module")
def predictor():
    return gsparc.load(town_model())


def test_gains_are_what_conditioning_takes_away():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    one = ErrorCovariance(root @ root.T, 0.3, np.full(6, 0.3), np.ones(6))
    every = np.ones(6, bool)
    gains, before = one.variance_reductions(every), one.variances().sum()
    for place in range(6):
        twin = ErrorCovariance(one.covariance.copy(), 0.3, one.measured, np.ones(6))
        twin.condition_on(place)
        assert before - twin.variances().sum() == pytest.approx(gains[place])


def test_error_falls_and_places_lie_where_data_do_not(predictor):
    area = [-40, 0, 80, 60]  # nobody was west of 0
    found = plan_measurements(predictor, 8, area, route=False)
    assert len(found.places) == 8 and found.after_db < found.before_db
    assert (np.diff(found.expected_db) < 0).all() and (found.places[:, 0] < 5).mean() > 0.7
    random = np.median(found.error_before)
    assert found.error_before[found.at[:, 0] < -20].mean() > random


def test_a_plan_lowered_errors_of_stations_that_serve_nowhere(predictor):
    """All counted alike, where a map shows the strongest, or which places reach a level."""
    level, spread = np.array([[-60.0, -60, -60], [-200, -60, -90]]), np.ones((2, 3))
    share = weigh_goal(level, spread, "strongest")
    assert share.sum(0) == pytest.approx(2) and share[0] == pytest.approx([2, 1, 2], abs=0.2)
    assert (weigh_goal(level, spread, "all") == 1).all()
    doubt = weigh_goal(level + np.array([0, 0, 10]), spread, "strongest", -60)
    assert doubt.sum(0)[0] > doubt.sum(0)[1] > 1e3 * doubt.sum(0)[
        2
    ] and doubt.mean() == pytest.approx(1)
    assert weigh_goal(level, spread, "strongest", 0) == pytest.approx(share)  # nothing is in doubt
    area = [0, 0, 80, 60]
    both = {goal: plan_measurements(predictor, 1, area, goal=goal) for goal in ("strongest", "all")}
    one = {
        goal: plan_measurements(predictor, 1, area, goal=goal, stations=["west"]) for goal in both
    }
    assert both["strongest"].before_db != pytest.approx(both["all"].before_db, rel=1e-3)
    assert one["strongest"].before_db == pytest.approx(one["all"].before_db)


def test_corridors_and_a_length(tmp_path, predictor):
    lines = {"type": "MultiLineString", "coordinates": [[[5, 5], [75, 5]], [[40, 5], [40, 55]]]}
    (tmp_path / "corridor.geojson").write_text(json.dumps(lines))
    found = plan_measurements(predictor, 10, walkable=tmp_path / "corridor.geojson", start=[5, 5])
    assert len(found.path) and not len(plan_measurements(predictor, 2, route=False).path)
    on = (np.abs(found.places[:, 1] - 5) < 1e-6) | (np.abs(found.places[:, 0] - 40) < 1e-6)
    assert on.all() and sorted(found.chosen.tolist()) == list(range(10))
    short = plan_measurements(
        predictor, 10, walkable=tmp_path / "corridor.geojson", start=[5, 5], route_m=30
    )
    assert short.length_m <= 30 and len(short.places) >= 1


def test_places_of_a_plan_were_two_lumps(predictor):
    """35 m apart on a campus; they are no nearer than half of what even ones are."""
    places = plan_measurements(predictor, 12, [-40, 0, 80, 60], route=False).places[:, :2]
    apart = cKDTree(places).query(places, k=2)[0][:, 1]
    assert apart.min() > 0.25 * np.sqrt(120 * 60 / 12)
    corners = np.array([[0.0, 0], [1, 0], [10, 0], [11, 0]])
    near = pairs_too_near(corners, 2)
    assert near[0].tolist() == [True, True, False, False]


def test_it_stops_where_a_place_gains_too_little(predictor):
    found = plan_measurements(predictor, 50, [-40, 0, 80, 60], least_gain_db=0.1)
    assert 0 < len(found.places) < 50 and "less than 0.1 dB" in found.stopped
    assert len(plan_measurements(predictor, 50, least_gain_db=50).places) == 0


def test_a_plan_went_to_corners_of_the_bounding_box_where_nothing_is_known(predictor):
    rng = np.random.default_rng(0)
    level, spread, row = rng.normal(size=60), np.ones(60), np.arange(60)
    evidence = HeldOutLevels(level, 0 * level, spread, row / 10, row, row % 2, row < 0)
    known = (
        np.column_stack([rng.uniform(0, [40, 60], (120, 2)), np.full(120, 1.5)])
        - predictor.site.origin
    )
    promise = Promise(evidence, known, np.arange(120) % 2, 5.0)
    found = plan_measurements(predictor, 6, promise=promise)
    reach = promise.calibration().reach
    assert (
        cKDTree(known + predictor.site.origin).query(found.at)[0].max()
        <= reach + found.grid.step
        < 10
    )
    assert found.places[:, 0].max() < 50 and not found.grid.inside[:, -1].any()
    assert plan_measurements(predictor, 6, [0, 0, 80, 60], promise=promise).at[:, 0].max() > 70


def promised(predictor, count, stations):
    """Evidence of rows that list so many of the two stations at each of `count` places."""
    rng, rows = np.random.default_rng(0), np.arange(count * stations)
    level = rng.normal(size=len(rows))
    evidence = HeldOutLevels(level, 0 * level, 1 + 0 * level, rows / 10, rows, rows % 2, rows < 0)
    known = np.column_stack([rng.uniform(0, [40, 60], (count, 2)), np.full(count, 1.5)])
    known = np.repeat(known - predictor.site.origin, stations, 0)
    return Promise(evidence, known, rows % 2, 5.0)


def test_a_plan_promised_what_lists_of_the_strongest_cannot_give(predictor):
    """A place counted as a measurement of all stations, of 24 cells of which 6 are listed."""
    area, names = [0, 0, 80, 60], predictor.site.stations.name
    whole, lists = (promised(predictor, 120, count) for count in (2, 1))
    assert whole.stations_of_place() == 2 and lists.stations_of_place() == 1
    gains = []
    for promise in (whole, lists):
        found = plan_measurements(predictor, 6, area, promise=promise, goal="all")
        gains.append(found.before_db - found.after_db)
    assert 0 < gains[1] < 0.8 * gains[0]
    places = np.array([[12.0, 20, 1.5], [68, 45, 1.5]])  # beside either mast
    measured = [one.measured for one in error_covariances(predictor, places, names, lists)]
    assert np.isinf(measured).tolist() == [[False, True], [True, False]]


def test_a_station_that_is_not_listed_was_learned_nothing_of_by_its_sites_others():
    class Sectors(JointMixin):
        def predict_joint(self, places, stations):
            field = np.array([[4.0, 3.2, 0], [3.2, 4, 0], [0, 0, 4]])
            known = np.tile(field + np.eye(3), (len(places), 1, 1))
            return JointLevels(np.zeros((len(places), 3)), known, np.ones(3))

    listed = np.array([[True, False, False]] * 2)
    own, beside, apart = Sectors().noise_by_others(np.zeros((2, 3)), [0, 1, 2], listed)[0]
    left = 4 - 3.2**2 / (4 + 1)  # variance of the second given the first
    assert own == pytest.approx(0) and 4 - 4**2 / (4 + 1 + beside) == pytest.approx(left)
    assert apart > 1e9


def test_a_long_walk_for_nothing_was_not_called_so(predictor):
    found = plan_measurements(predictor, 1, route=True)
    assert (
        "hardly worth measuring: 1 places" in found.in_vain
        and 0 < found.scatter_db < found.before_db
    )
    assert not plan_measurements(None, 9, [0, 0, 30, 30]).in_vain


def test_a_walk_is_not_longer_than_it_must_be():
    rng = np.random.default_rng(0)
    at = rng.permutation(12)[:, None]
    tour = Tour(np.abs(at - at.T) * 1.0, int(np.argmin(at)), None)
    for place in rng.permutation(np.flatnonzero(at)):
        tour.add(place)
    assert tour.metres[-1] == pytest.approx(11) and sorted(tour.walk[1:-1]) == sorted(
        np.flatnonzero(at)
    )


def test_a_drive_went_straight_from_place_to_place_where_streets_were_given():
    shapely = pytest.importorskip(
        "shapely", reason="shapely is not installed: pip install 'gsparc[maps]'"
    )
    grid = [[[0, 0], [100, 0]], [[50, -50], [50, 50]], [[0, 40], [100, 40]], [[200, 0], [300, 0]]]
    streets = StreetGraph.from_lines([shapely.LineString(line) for line in grid], 10)
    ways = Ways.between(np.array([[0.0, 0], [10, 40], [200, 0], [-5, 0]]), streets)
    # By the crossing at (50, 0) and that at (50, 40), though no corner of a line is there.
    assert ways.length[0, 1] == pytest.approx(50 + 40 + 40)
    assert ways.length[3, 1] == pytest.approx(5 + 130)  # from beside the street
    # Streets that do not meet
    assert ways.length[0, 2] == pytest.approx(200) and not ways.along[0, 2]
    path = ways.path_through(np.array([0, 1]))
    assert [50, 0] in path.tolist() and [50, 40] in path.tolist()
    assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(130)
