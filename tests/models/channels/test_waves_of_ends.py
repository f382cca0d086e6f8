"""Channels of several static ends in one field."""

import numpy as np
import pytest
import torch
from ceilings import WAVENUMBER, ceiling, tied
from closed import fitted_to
from releases import real
from scenes import answer_error, fold_of

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.complex_gp import ComplexGP
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.channels.kernels import fibonacci_sphere
from gsparc.models.channels.terms import Directions
from gsparc.models.channels.terms.term import Frame
from gsparc.models.gsparc import Gsparc
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.per_station import wrap_per_station
from gsparc.prediction.predictor import Predictor
from gsparc.training.context import FitContext

QUICK = ChannelSettings(tied=12, narrow=5.0, knots=4, angles=8, rows=60)


def test_knots_add_up_and_mirrored_directions_count_alike():
    half, zero = fibonacci_sphere(800), torch.zeros(3, dtype=torch.float64)
    half = half[half[:, 2] > 0]
    term = Directions(
        Frame(zero, 10.0, 1.0, 1.0, zero),
        torch.ones(len(half)).double(),
        angles=half,
        concentration=8.0,
        towards=torch.zeros(5).double(),
    )
    ends = torch.tensor([[1.0, 0.5, 2.0], [1.0, 0.5, -2.0]], dtype=torch.float64)
    found = term.knot_weights([Slot(0, (0,), (0,), end, zero, WAVENUMBER) for end in ends])
    torch.testing.assert_close(found.sum(-1), torch.ones(2, len(half)).double())
    torch.testing.assert_close(found[0], found[1], atol=0.05, rtol=0)


def test_each_end_has_the_covariance_of_its_own_powers():
    data = ceiling()
    field = tied(data, np.arange(len(data)))
    term, slots = field.prior[Directions], [one.group.slot for one in field.weights]
    places = field.weights[0].group.places[:10]
    ends = [SlotPlaces(slot, places) for slot in slots]
    powers, together = term.direction_powers(slots), list(term.end_covariances(ends, ends))
    for number in (0, 3):
        alone = term.covariance(ends[number], ends[number])
        torch.testing.assert_close(together[number], alone)
        torch.testing.assert_close(alone.diagonal().real, term.variance(ends[number]))
    assert not torch.allclose(powers[0], powers[1])


@pytest.mark.slow
def test_an_end_that_was_never_heard_has_the_direct_wave():
    data = ceiling(ends=9, turned=0.2)
    known, left = np.flatnonzero(data.station < 7), np.flatnonzero(data.station >= 7)
    field, _ = fitted_to(ChannelField(QUICK), data, known)
    batch, same = data.batch(left), data.batch(known)
    with torch.no_grad():
        found = field.predict(batch)
        of_places = field.predict(Query(batch.tx, batch.rx))
        torch.testing.assert_close(of_places.mean, found.mean)
        heard = field.predict(same)
    missed = (found.mean - batch.target).abs().square().mean()
    assert missed < 0.9 * batch.target.abs().square().mean()
    assert 0.2 < float(missed / found.variance.mean()) < 4
    assert found.unknown.mean() > 3 * heard.unknown.mean()


@pytest.mark.slow
def test_stations_together_are_asked_for_any_pair():
    data = ceiling(ends=4, count=36)
    rows = np.flatnonzero(data.station < 3)
    method = wrap_per_station(Gsparc(), data)
    method.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext(stations="together"))
    again = wrap_per_station(Gsparc(), data)
    again.restore(data.site, method.state())
    places = data.site.stations.position + data.site.origin
    here = np.array([0.3, 0.3, 0.2])
    for one in (method, again):
        asked = Predictor(one, data.site)
        own = asked.csi(tx=here, rx=places[1])
        np.testing.assert_allclose(asked.select_station(1).csi(tx=here), own, rtol=1e-5)
        elsewhere = asked.predict(tx=here[None].repeat(2, 0), rx=places[[1, 3]])
        assert elsewhere.confidence[0] > elsewhere.confidence[1] + 0.2
    batch = data.batch(rows[:40])
    torch.testing.assert_close(again.predict(batch).mean, method.predict(batch).mean)


def test_methods_of_one_end_are_refused_as_before():
    data = ceiling(ends=3, count=30)
    rows = np.arange(len(data))
    fold, method = Fold(rows, rows[:0], rows[:0]), wrap_per_station(ImageSourceGP(), data)
    with pytest.raises(ValueError, match="stations=each"):
        method.fit(data, fold, FitContext(stations="together"))


@pytest.mark.slow
def test_measured_ceiling_in_squares():
    from gsparc.datasets.techtile import Techtile

    data = Techtile(
        real("real/techtile-csi-920mhz.npz"), runs=["EXP006"], stations=list(range(0, 42, 4))
    ).load()
    fold = fold_of(data, name="blocks", side_m=0.6)
    field, _ = fitted_to(ChannelField(), data, np.concatenate([fold.train, fold.val]))
    plain = wrap_per_station(ComplexGP(), data)
    plain.fit(data, fold, FitContext())
    assert answer_error(field, data, fold.test) < 0.55 * answer_error(plain, data, fold.test)
