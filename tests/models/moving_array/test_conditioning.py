"""Sources seen by a moving array as a field: its parts, its rows, what it does not know."""

import dataclasses

import numpy as np
import pytest
import torch
from boxes import room_of_spectra
from closed import read_back

from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.mixture.candidates import bearings
from gsparc.models.moving_array.triangulate import site_problem
from gsparc.training.context import FitContext

ROWS = np.arange(0, 160, 2)
INIT = InitSettings(searches=1, max_sources=9)


@pytest.fixture(scope="module")
def data():
    return room_of_spectra()


@pytest.fixture(scope="module")
def found(data, tmp_path_factory):
    context = FitContext(tmp_path_factory.mktemp("run"))
    method = bearings(INIT, True, context)
    return method, method.fit(data, Fold(ROWS, ROWS[:0], ROWS[:0]), context)


@pytest.fixture
def field(data, found):
    """A copy of its own, with all that conditioning leaves."""
    again = read_back(found[0])
    again.condition(data, ROWS)
    return again


def missed(field, data, rows):
    batch = data.batch(rows)
    return float((field.predict(batch).mean - batch.target).square().mean())


def test_sources_are_found_within_the_settings(data, found):
    field, report = found
    assert field.count == 9 and field.terms == ("moving_array", "residual") and report.seconds > 0
    np.testing.assert_array_equal(
        field.found.sources[0], np.float32(data.site.static_position)
    )  # it stays there
    assert "9 sources" in report.notes[0]
    assert site_problem(data) is None
    bare = dataclasses.replace(data, site=dataclasses.replace(data.site, array=None))
    assert "no array" in str(site_problem(bare))


def test_the_mean_is_what_sources_explain_and_the_residual(data, field):
    batch = data.batch(np.arange(1, 31, 2))
    posterior, method = field.predict(batch), field
    explained, mean, energy, _ = method.query()(batch.places(data.site))
    torch.testing.assert_close(posterior.explained, explained.clamp(0, 1))
    added = method.basis.of(mean - explained)
    torch.testing.assert_close(added.square().sum(1), energy, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(
        posterior.mean, (explained + method.basis.images(added)).clamp(0, 1), rtol=0, atol=1e-4
    )
    assert missed(field, data, np.arange(1, 160, 2)) < float(
        (explained.clamp(0, 1) - batch.target).square().mean()
    )
    assert posterior.variance.shape == posterior.unknown.shape == (15,)


def test_more_rows_condition_it_better(data, field):
    places = field.found.sources.clone()
    test = np.arange(1, 160, 4)
    before = missed(field, data, test)
    field.condition(data, np.concatenate([ROWS, np.arange(3, 160, 4)]))
    assert missed(field, data, test) < before
    assert len(field.left_out().rows) == 120
    assert torch.equal(places, field.found.sources)
    field.condition(data, ROWS)
    assert missed(field, data, test) == pytest.approx(before, rel=1e-3)


def test_left_out_rows_are_about_as_wrong_as_new_ones(data, field):
    left = field.left_out()
    np.testing.assert_array_equal(left.rows, ROWS)
    error = (left.mean - data.batch(ROWS).target).square().mean((1, 2))
    torch.testing.assert_close(left.variance, error, rtol=1e-4, atol=1e-7)
    assert 0.5 < float(error.mean()) / missed(field, data, np.arange(1, 160, 2)) < 2


def test_an_empty_set_of_rows_is_refused(data, field):
    with pytest.raises(ValueError, match="empty"):
        field.condition(data, ROWS[:0])
