"""Powers of many ends in one field: exact conditioning, stations never heard, silent rows, wiring,
state.
"""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from closed import fitted_to
from known_fields import known_field
from refusals import refused
from releases import real
from scenes import fold_of

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.ble import BLE
from gsparc.field.initial import InitSettings
from gsparc.models.gsparc import Gsparc, choose
from gsparc.models.per_station import wrap_per_station
from gsparc.models.powers.together import field as together
from gsparc.models.powers.together import learning
from gsparc.models.powers.together.field import JointPowerField, rows_per_station
from gsparc.models.powers.together.learning import (
    StationPriors,
    learn_own_settings,
    learn_shared_terms,
    learn_station_priors,
)
from gsparc.models.powers.together.terms import (
    SharedTerms,
    StationRows,
    places_and_notes,
    rows_of_stations,
)
from gsparc.models.registry import method_class
from gsparc.ops import Pose
from gsparc.processes.kernel import Kernel
from gsparc.processes.prior import Prior
from gsparc.processes.shared import left_out_processes
from gsparc.processes.trend import Law, Trend
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

POSTS = np.array([[0.0, 0, 6], [60, 5, 6], [5, 55, 6], [50, 60, 6], [30, -5, 6], [-5, 30, 6]])
LEVELS = np.array([0.0, 4.0, -5.0, 2.0, -2.0, 3.0])


@cache
def town(count: int = 90, shared_db: float = 4.0, posts: int = 6) -> Measurements:
    """A square before six stations: a law, what all hear alike at a place, a residual of each,
    noise.
    """
    rng = np.random.default_rng(3)
    walk = np.c_[rng.uniform(8, 50, (count, 2)), np.full(count, 1.5)]
    far = np.linalg.norm(walk[:, None] - POSTS[:posts], axis=-1)
    decibels = -20 - 30 * np.log10(far) + LEVELS[:posts]
    decibels += smooth(walk, 12, rng, 1)[:, 0, None] * shared_db
    decibels += 2 * smooth(walk, 8, rng, posts) + rng.standard_normal(far.shape)
    return from_arrays(
        {"tx_position": walk, "station_position": POSTS[:posts], "rssi_db": decibels},
        {"name": "town"},
    )


def smooth(places: np.ndarray, length: float, rng: np.random.Generator, count: int) -> np.ndarray:
    """(n, count) fields of variance 1."""
    waves = rng.normal(size=(2, 200)) / length
    phases = places[:, :2] @ waves + rng.uniform(0, 2 * np.pi, 200)
    return np.cos(phases) @ rng.normal(size=(200, count)) / 10


def prior_of(data: Measurements) -> tuple[StationPriors, SharedTerms]:
    """Invented settings with every term."""
    trend = Trend(0.0, Law(36.0, 2.5, 2.0, 6.0, None), 1.5, 0.8)
    never = Prior(Kernel.from_lengths((4.0, 20.0), (0.4, 0.6), 0.1, 14.0), trend)
    own = StationPriors(
        never, {1: Prior(Kernel.from_lengths((6.0, 25.0), (0.4, 0.6), 0.2, 18.0), trend)}
    )
    terms = SharedTerms.from_rows(rows_of(data), trend, 8.0, 30, 0)
    return own, replace(terms, place_db=2.7)


def rows_of(data: Measurements, rows: np.ndarray | None = None):
    rows = np.arange(len(data)) if rows is None else rows
    return rows_of_stations(data, rows, places_and_notes(data, rows)[0])


def dense(rows, own: StationPriors, terms: SharedTerms) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (n, n) of rows with noise, and values (n,) less the law,
    by what the prior says of pairs.
    """
    places = torch.from_numpy(rows.places)
    columns = terms.columns(places)
    total = columns @ columns.T
    for number in rows.stations:
        at, prior = np.flatnonzero(rows.station == number), own.prior(number)
        block = prior.cross_covariance(places[at], places[at]) + prior.kernel.noise * torch.eye(
            len(at)
        )
        total[np.ix_(at, at)] += prior.kernel.amplitude * block
    return total.numpy(), rows.decibels - terms.trend.mean(places).numpy()


def db(power: torch.Tensor) -> np.ndarray:
    return 10 * np.log10(power.numpy().astype(float)).reshape(-1)


def spread_db(found) -> np.ndarray:
    return np.sqrt(found.variance.numpy()) / (np.log(10) / 10 * found.mean.numpy()[:, 0])


def test_it_is_the_dense_process():
    data = town(40)
    (own, terms), every = prior_of(data), rows_of(data)
    known, asked = every.subset(np.arange(0, 200)), every.subset(np.arange(200, 240))
    known = known.subset(np.flatnonzero(known.station != 4))  # never heard
    posterior, count = own.condition(known, terms, 0), len(known.index)
    gram, values = dense(joined(known, asked), own, terms)
    inner = np.linalg.solve(gram[:count, :count], np.c_[values[:count], gram[:count, count:]])
    mean = gram[count:, :count] @ inner[:, 0]
    variance = gram[count:, count:].diagonal() - (gram[count:, :count] * inner[:, 1:].T).sum(1)
    places = torch.from_numpy(asked.places)
    rounded = posterior.answer(places, torch.from_numpy(asked.station))
    said = posterior.answer(places, torch.from_numpy(asked.station), float64=True)
    assert np.allclose(rounded[0], said[0], atol=1e-4) and np.allclose(
        rounded[1], said[1], atol=1e-4
    )
    assert np.allclose(said[0].numpy(), asked.decibels - values[count:] + mean, atol=1e-8)
    assert np.allclose(said[1].numpy(), variance, atol=1e-8)
    known = gram[count:, count:] - gram[count:, :count] @ inner[:, 1:]
    for number in asked.stations:
        at = np.flatnonzero(asked.station == number)[:2]
        together = posterior.predict_joint(places[at][None], number)[1][0]
        assert np.allclose(together.numpy(), known[np.ix_(at, at)], atol=1e-8)


def test_all_stations_at_once_are_answered_as_one_by_one():
    data = town(40)
    (own, terms), every = prior_of(data), rows_of(data)
    own = replace(own, heard={})
    rng = np.random.default_rng(0)
    known = every.subset(np.flatnonzero(rng.random(240) < np.linspace(0.3, 0.9, 6)[every.station]))
    posterior = own.condition(known, terms, 0)
    places, number = torch.from_numpy(every.places[:15]), torch.from_numpy(every.station[:15])
    mean, left = posterior.answer(places, number, float64=True)
    for one in number.unique().tolist():
        alone = posterior.answer(places[number == one], number[number == one], float64=True)
        assert torch.allclose(mean[number == one], alone[0], atol=1e-9)
        assert torch.allclose(left[number == one], alone[1], rtol=1e-5)


def joined(*parts):
    """Rows of all parts as one."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return type(parts[0])(*map(np.concatenate, columns))


def test_rows_and_stations_left_out():
    data = town(25)
    (own, terms), every = prior_of(data), rows_of(data)
    gram, values = dense(every, own, terms)
    inverse = np.linalg.inv(gram)
    error, variance = inverse @ values / inverse.diagonal(), 1 / inverse.diagonal()
    posterior = own.condition(every, terms, 0)
    whole = left_out_processes([posterior.block(number) for number in every.stations])
    for number, of_station in zip(every.stations, whole, strict=True):
        at = np.flatnonzero(every.station == number)
        found = posterior.left_out(number)
        assert np.allclose(found[0].numpy(), error[at]) and np.allclose(
            found[1].numpy(), variance[at]
        )
        rest = np.setdiff1d(np.arange(len(gram)), at)
        told = np.linalg.solve(
            gram[np.ix_(rest, rest)], np.c_[values[rest], gram[np.ix_(rest, at)]]
        )
        mean = gram[np.ix_(at, rest)] @ told[:, 0]
        spread = gram[at, at] - (gram[np.ix_(at, rest)] * told[:, 1:].T).sum(1)
        assert np.allclose(of_station[0].numpy(), values[at] - mean)
        assert np.allclose(of_station[1].numpy(), spread)


def test_the_law_of_a_site():
    own, notes = learn_station_priors(rows_of(town(90, 0.0)), 0)
    law = own.never.trend.law
    assert abs(law.exponent - 3) < 0.7 and "6 stations in one model" in notes[0], law


def test_settings_become_likelier():
    rows, densities = rows_of(town()), []
    learned, _ = learn_station_priors(rows, 0)
    begin = StationPriors(
        replace(learned.never, kernel=Kernel.from_lengths((3.0, 30.0), (0.5, 0.5), 0.3, 20.0)), {}
    )
    for own in (begin, learned):
        posterior = own.condition(rows, prior_of(town())[1], 0)
        found = [posterior.left_out(number) for number in rows.stations]
        densities.append(
            sum(float((e.square() / v + v.log()).sum()) for e, v in found) / len(rows.index)
        )
    assert densities[1] < densities[0] - 0.01


@pytest.fixture(scope="module")
def learned():
    """A field of 60 of 90 places."""
    data = town()
    fold = fold_of(data, val_fraction=0)
    rows = fold.train
    field, notes = fitted_to(JointPowerField(), data, rows)
    field.condition(data, rows)
    return data, fold, field, notes


def test_what_all_hear_alike_is_found(learned):
    data, fold, field, notes = learned
    assert field.unheard.place_db and not field.heard.place_db, notes
    batch = data.batch(fold.test)
    found = field.predict(batch)
    error = db(found.mean) - db(batch.target)
    assert np.mean(np.abs(error) < 1.645 * spread_db(found)) > 0.8


def test_a_station_never_heard_gains_from_the_others():
    data = town()
    rows = np.flatnonzero(data.station != 3)
    asked = data.batch(np.flatnonzero(data.station == 3))
    field, notes = fitted_to(JointPowerField(), data, rows)
    field.condition(data, rows)
    found = field.predict(Query(asked.tx, asked.rx))
    error = db(found.mean) - db(asked.target)
    places = torch.from_numpy(data.moving[asked.index.numpy()])
    still = torch.from_numpy(POSTS[3] - data.site.origin).expand(len(places), 3)
    by_law = field.heard.trend.mean(torch.cat([places, still], 1)).numpy() - db(asked.target)
    assert error.std() < 0.85 * by_law.std(), notes
    assert np.mean(np.abs(error) < 2.6 * spread_db(found)) > 0.8
    assert spread_db(found).min() > 2  # its level is not known


def test_either_end_may_be_the_station(learned):
    data, fold, field, _ = learned
    batch = data.batch(fold.test[:20])
    turned = Pose(batch.tx, batch.rx.rotation)
    there, back = (
        field.predict(Query(batch.tx, batch.rx)),
        field.predict(Query(batch.rx.position, turned)),
    )
    assert torch.allclose(there.mean, back.mean, rtol=1e-4)
    assert torch.allclose(there.mean, field.predict(batch).mean, rtol=1e-4)


def test_silent_rows_say_that_powers_are_low():
    data = town(60)
    level = np.quantile(data.target, 0.3)
    quiet = data.target[:, 0] < level
    silent = replace(
        data,
        target=np.where(quiet[:, None], level, data.target),
        mask=~quiet[:, None],
        censored=quiet,
    )
    (own, terms), rows = prior_of(data), np.arange(len(data))
    errors = []
    for used in (rows, rows[~quiet]):
        field = known_field(data.site, places_and_notes(data, rows)[0], own, terms)
        field.condition(silent, used)
        batch = data.batch(np.flatnonzero(quiet))
        errors.append(np.mean((db(field.predict(batch).mean) - db(batch.target)) ** 2))
    assert errors[0] < errors[1]
    assert fitted_to(JointPowerField(), silent, rows)[1]


def test_a_station_whose_place_nobody_gave():
    data = town(90, 0.0)
    gone = data.site.stations.position.copy()
    gone[2] = np.nan
    site = replace(data.site, stations=replace(data.site.stations, position=gone))
    field, notes = fitted_to(
        JointPowerField(shared=False), replace(data, site=site), np.arange(len(data))
    )
    field.condition(replace(data, site=site), np.arange(len(data)))
    assert any("place of station" in note for note in notes)
    assert np.linalg.norm((field.places - data.site.stations.position)[2, :2]) < 40
    batch = replace(data, site=site).batch(np.flatnonzero(data.station == 2)[:5])
    assert torch.isfinite(field.predict(batch).mean).all()


def test_levels_that_are_equal_at_each_station_had_no_definite_covariance():
    data = town(20)
    level = (-80 - 3 * data.station)[:, None]
    same = replace(data, target=(10 ** (level / 10)).astype(np.float32))
    heard = np.flatnonzero(data.station != 0)
    field, _ = fitted_to(JointPowerField(), same, heard)
    asked = same.batch(heard[:40])
    assert np.abs(db(field.predict(asked).mean) - level[heard[:40], 0]).max() < 0.01
    assert np.isfinite(db(field.predict(same.batch(np.flatnonzero(data.station == 0))).mean)).all()


def test_a_station_of_no_known_place_that_was_never_heard_was_no_number():
    data = town(20)
    gone = data.site.stations.position.copy()
    gone[2:4] = np.nan
    lost = replace(
        data, site=replace(data.site, stations=replace(data.site.stations, position=gone))
    )
    of = [np.flatnonzero(data.station == number) for number in range(6)]
    fold = Fold(np.concatenate([of[0], of[1], of[3], of[4], of[5]]), of[0][:0], of[2])
    method = wrap_per_station(Gsparc(), lost)
    with pytest.raises(
        ValueError, match=r"needs them for those without training rows \(.*2\); give them"
    ):
        method.fit(lost, fold, FitContext(stations="together"))


def test_rows_are_thinned_at_places_that_stations_share():
    few = rows_of(town()).thin_rows(20, 0)
    assert np.array_equal(np.bincount(few.station), [20] * 6)
    assert len(np.unique(few.places[:, :3], axis=0)) == 20
    assert (
        rows_per_station(1) == together.MOST_ROWS
        and 3_500 < rows_per_station(12) < together.MOST_ROWS
    )


def test_what_it_refuses():
    data = town()
    with pytest.raises(ValueError, match="several stations"):
        fitted_to(
            JointPowerField(), replace(data, site=replace(data.site, stations=None)), np.arange(4)
        )
    refused("at least one row", fitted_to, JointPowerField(), data, np.arange(0))
    refused(
        "stations=each", choose, data, Gsparc(init=InitSettings(name="scene", file="walls.yaml"))
    )
    own, terms = prior_of(data)
    refused("not fitted yet", known_field(data.site, POSTS, own, terms).left_out)


def test_stations_at_one_place_are_told_apart_by_their_numbers():
    data = town()
    position = data.site.stations.position.copy()
    position[1] = position[0]  # a sector, or the same one after its gain changed
    data = replace(
        data, site=replace(data.site, stations=replace(data.site.stations, position=position))
    )
    data = replace(data, rx_position=position[data.station])
    far = np.linalg.norm(data.tx - data.rx_position, axis=1)
    decibels = -20 - 30 * np.log10(far) + 10 * (data.station == 1)
    data = replace(data, target=(10 ** (decibels / 10)).astype(np.float32)[:, None])
    rows = np.flatnonzero(data.station < 4)
    method = wrap_per_station(Gsparc(), data)
    method.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext(stations="together"))
    batch = data.batch(np.flatnonzero(data.station < 2))
    assert np.abs(db(method.predict(batch).mean) - db(batch.target)).max() < 2


@pytest.mark.slow
def test_halls_gain_over_a_process_of_each_sensor():
    data = BLE(file=str(real("real/ble-hall-1.npz"))).load()
    fold = fold_of(data, name="blocks", side_m=3.0)
    errors = []
    for make, stations in ((Gsparc, "together"), (method_class("gp"), "each")):
        method = wrap_per_station(make(), data)
        method.fit(data, fold, FitContext(stations=stations))
        batch = data.batch(fold.test)
        errors.append(np.mean((db(method.predict(batch).mean) - db(batch.target)) ** 2))
    assert errors[0] < errors[1], errors


def test_the_error_of_a_gain_is_that_of_stations():
    every = rows_of(town())
    own, _ = learn_station_priors(every, 0)
    turned = every.subset(np.argsort(every.station, kind="stable"))
    said = (learn_shared_terms(rows, own, 0)[2] for rows in (every, turned))
    (gain, error), other = (
        np.array(re.findall(r"gain (\S+) \+- (\S+)", one)[0], float) for one in said
    )
    assert np.isclose(gain, other[0], rtol=0.3) and np.isclose(error, other[1], rtol=0.5)
    assert error > 0.05 * gain


def test_lists_of_the_strongest_were_all_that_settings_were_learned_from(monkeypatch):
    """Half the variance: 90 % intervals of whole runs left out held .76 to .82."""
    monkeypatch.setattr(learning, "ENDS_FROM", 60)
    rng = np.random.default_rng(2)
    places, stations = (np.pad(rng.uniform(0, 1000, (n, 2)), ((0, 0), (0, 1))) for n in (150, 9))
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / 150) + 1e-9 * np.eye(len(places)))
    level = -30 - 30 * np.log10(np.linalg.norm(places[:, None] - stations, axis=-1))
    level += 8 * root @ rng.normal(size=level.shape) + 2 * rng.normal(size=level.shape)
    weakest = np.sort(level, 1)[:, -3:-2]
    at, who = (part.ravel() for part in np.indices(level.shape))
    side = (level < weakest).astype(np.int8).ravel()
    rows = StationRows(
        np.c_[places[at], stations[who]],
        np.maximum(level, weakest).ravel(),
        side,
        who,
        np.arange(len(at)),
    )
    priors, notes = learn_own_settings(rows, learn_station_priors(rows, 0)[0], 0)
    # 64 of shadowing and 4 of noise; of what is listed alone 37.
    assert 50 < priors.variance < 90
    assert any("settings of their own" in note for note in notes)


def test_a_median_station_of_one_row_took_the_kernel_of_all_into_a_corner():
    """Its residual was exactly 0: the slope was NaN, and 42 stations had next to no noise;
    +47 dBm of it.
    """
    data = town(60)
    rows = rows_of(data)
    trend, _ = learning._fit_site_law(rows, 0)
    single = rows.subset(np.arange(1))
    places = np.r_[rows.places[1, :3], [30.0, 25.0, 6.0]][None]
    level = trend.mean(torch.from_numpy(places)).numpy()
    single = replace(single, places=places, decibels=level, station=np.array([6]))
    before, after = (
        learn_station_priors(part, 0)[0].never.kernel for part in (rows, joined(rows, single))
    )
    assert after.noise == pytest.approx(before.noise, rel=0.3)
    assert after.lengths == pytest.approx(before.lengths, rel=0.3)


def test_a_row_less_drew_other_stretches_for_all_settings():
    """Of a campus 1 % less moved answers at walked places by 1.6 and 2.3 dB, now by .3 to .5."""
    places, none = np.c_[np.random.default_rng(5).normal(size=(4000, 3)).cumsum(0)], np.zeros(4000)
    rows = StationRows(np.c_[places, places], none, none, none, np.arange(4000))
    less = rows.subset(np.delete(np.arange(4000), [7, 1000, 3000]))
    drawn, again = (part.draw_stretches(400, 0).index for part in (rows, less))
    assert len(drawn) == 400 and len(np.intersect1d(drawn, again)) > 380
    assert (np.diff(drawn) == 1).mean() > 0.7
