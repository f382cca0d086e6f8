"""Triangulated sources, their visibility, and channels from both."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from releases import real
from rooms import directed
from scenes import error

from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold, make_split
from gsparc.datasets.load import load
from gsparc.field.initial import InitSettings
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.directional.visibility import RayErrorRates, entries_to_flip
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.rows import rows_of_measurements
from gsparc.models.image_sources.scene import spherical_waves
from gsparc.models.image_sources.search import Search, SearchSettings
from gsparc.models.mixture.candidates import CANDIDATES
from gsparc.models.mixture.methods import ImageSources
from gsparc.models.terms import EffectSettings
from gsparc.runs.experiment.disturb import add_direction_errors
from gsparc.training.context import FitContext


def fitted(data, fold, **settings):
    method = DirectionalGP(**settings)
    return method, method.fit(data, fold, FitContext()).notes[0]


@pytest.fixture(scope="module")
def pillar():
    data, fold, sources = directed(150, pillar=True)
    return data, fold, sources, fitted(data, fold)[0]


def test_few_receivers_are_enough_with_directions():
    data, _, sources = directed(60)
    rows = np.arange(60)
    fold = Fold(rows[:12], rows[12:14], rows[14:])
    method, note = fitted(data, fold)
    found = method.posterior.positions.points + method.frame.middle
    apart = torch.cdist(torch.from_numpy(sources), found).amin(1)
    assert len(found) == len(sources) == 7 and float(apart.max()) < 0.02
    assert error(method, data, fold.test) < 0.02
    assert "7 sources where directions cross" in note


def test_a_search_starts_from_sources_where_rays_meet():
    data, _, sources = directed(60)
    rows = np.arange(60)
    fold, still = (
        Fold(rows, rows[:0], rows[:0]),
        torch.from_numpy(data.site.static_position).double(),
    )
    method = fitted(data, fold)[0]
    found = method.points_and_amplitudes()
    for order, expected in ((3, torch.from_numpy(sources)), (0, still[None])):
        settings = SearchSettings(order=order)
        start = Search(
            rows_of_measurements(data, rows, 100, 0), still, settings, 0, lambda: False, found
        ).scene.sources
        assert (
            len(start) == len(expected) and float(torch.cdist(expected, start).amin(1).max()) < 0.02
        )
    context, init = FitContext(beside={"rays": method}), InitSettings()
    assert torch.equal(CANDIDATES["sources"](init, True, context).start[0], found[0])
    assert CANDIDATES["sources"](init, True, FitContext()).start is None


def test_rows_left_out_are_predicted_as_by_a_fit_without_the_receiver():
    data, fold, _ = directed(40, pillar=True, tones=3)
    method, _ = fitted(data, fold, rows=96)
    left = method.left_out()
    assert len(left.rows) == 96  # three tones each
    given, k = method.posterior, 7
    rows, waves = given.rows, given.waves
    kept = torch.nonzero(given.observer != k).flatten()
    out = torch.nonzero(given.observer == k).flatten()
    shared = (waves[kept] * given.power) @ waves[kept].mH
    shared *= given.kernel.correlation(rows.position[kept], rows.position[kept])
    shared.diagonal().add_(given.kernel.noise + 1e-5)
    probability = (
        spherical_waves(rows.select_rows(out), given.positions.points)
        * given.visibility.left_out[k].float()
    )
    cross = (probability * given.power) @ waves[kept].mH
    cross *= given.kernel.correlation(rows.position[out], rows.position[kept])
    predicted = cross @ torch.linalg.solve(shared, rows.target[kept])
    loud = (method.frame.carrier_hz / rows.frequency[out]).float()[:, None] * method.frame.scale
    torch.testing.assert_close(left.mean[out].squeeze(-1), predicted * loud, atol=1e-4, rtol=1e-2)


@pytest.mark.parametrize(
    "degrees", [1.0, *(pytest.param(d, marks=pytest.mark.slow) for d in (0.2, 3.0))]
)
def test_direction_errors_are_estimated_and_positions_refined_by_phase(degrees):
    """Directions taken as exact left NMSE 0.08, 0.45 and 0.70."""
    data, fold, sources = directed(60, pillar=True)
    method, note = fitted(add_direction_errors(data, degrees, seed=0), fold)
    assert error(method, data, fold.test) < (0.07 if degrees < 2 else 0.25)
    estimated = float(note.partition("error ")[2].partition(" degrees")[0])
    assert abs(estimated / degrees - 1) < 0.3
    found = method.posterior.positions.points + method.frame.middle
    apart = torch.cdist(torch.from_numpy(sources), found).amin(1)
    assert len(found) == 7 and float(apart.median()) < 0.06  # half a wavelength


def test_missing_and_spurious_rays_neither_add_nor_remove_sources():
    data, fold, _ = directed(60, pillar=True)
    method, note = fitted(add_direction_errors(data, 1.0, seed=1, missing=0.1, false=0.1), fold)
    assert method.count_components() == 7 and " 0 pairs of receiver" not in note
    assert error(method, data, fold.test) < 0.08  # rays alone: 0.17


def test_a_channel_restores_a_missed_ray():
    rng = torch.Generator().manual_seed(0)
    one = torch.randn(20, 4, 1, generator=rng, dtype=torch.complex64)
    truth = torch.ones(20, 4)
    rays = truth.clone()
    rays[torch.arange(20), torch.arange(20) % 4] = 0
    left = ((truth - rays)[:, :, None] * one).sum(1)
    rates = RayErrorRates.from_rays(rays)
    assert rates.missed == 0.2  # a quarter, clipped at first
    probability = torch.full((20, 4), 0.75)
    flip = entries_to_flip(
        rays, rates.log_odds_seen(rays, probability), left, torch.full((20,), 1e-3), one
    )
    assert torch.equal(flip, (truth - rays).bool())
    estimated = RayErrorRates.from_visibility(rays, truth)
    assert abs(estimated.missed - 0.25) < 1e-6 and estimated.spurious == 1e-3
    # no neighbour sees it and the residual is zero: noise adds no visibility
    quiet = entries_to_flip(
        rays, rates.log_odds_seen(rays, 0 * probability), 0 * left, torch.ones(20), one
    )
    assert not bool(quiet[rays == 0].any())


@pytest.mark.parametrize("seen", [0.0, 1.0])
def test_where_every_ray_was_wrong_the_odds_divided_by_zero(seen):
    """One channel of 80 dB too much hides all sources from all receivers:
    a share of one has no odds.
    """
    rays, truth = torch.full((4, 2), 1 - seen), torch.full((4, 2), seen)
    assert torch.isfinite(
        RayErrorRates.from_visibility(rays, truth).log_odds_seen(rays, 0.5 * torch.ones(4, 2))
    ).all()


def _random_rays(data):
    rays = np.random.default_rng(0).normal(size=(len(data.directions), 5, 3)).astype(np.float32)
    return replace(data, directions=list(rays / np.linalg.norm(rays, axis=-1, keepdims=True)))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_random_rays, "do not intersect"),
        (lambda data: replace(data, directions=None), "needs directions of arrival"),
        (
            lambda data: replace(data, directions=[d[:0] for d in data.directions]),
            "do not intersect",
        ),
        (lambda data: replace(data, target=0 * data.target), "every training channel is zero"),
    ],
)
def test_unusable_data_are_refused_in_one_line(spoil, message):
    data, fold, _ = directed(60, pillar=True)
    with pytest.raises(ValueError, match=message):
        fitted(spoil(data), fold)


@pytest.mark.slow
def test_the_conference_room_from_43_receivers():
    """A search finds nothing there: NMSE 1.1; a network along the rays leaves 0.17."""
    data = load({"name": "newrf", "file": str(real("newrf-conference.npz"))})
    fold = make_split(data.moving, SplitSettings(name="sparse")).folds[0]
    method, _ = fitted(data, fold)
    assert len(fold.train) + len(fold.val) == 43
    assert error(method, data, fold.test) < 0.08
    searched = ImageSourceGP(searches=1, clutter=False)
    searched.fit(data, fold, FitContext(effort=0.3))
    assert error(searched, data, fold.test) > 0.5


def test_visibility_that_was_switched_off_was_learned_all_the_same(pillar):
    """An ablation of `visibility` compared two equal fits wherever directions were measured."""
    data, fold, _, method = pillar
    alone = EffectSettings(visibility=False, residual=False), None, InitSettings("rays")
    blind = ImageSources(*alone)
    notes = blind.fit(data, fold, FitContext()).notes
    assert method.terms == ("phase", "visibility") and blind.effects == "phase"
    assert "visibility" not in notes[0] and error(blind, data, fold.test) > 2 * error(
        method, data, fold.test
    )


def test_the_log_counted_the_sources_of_a_fit_before_the_last(pillar, caplog, monkeypatch):
    """46 Gaussians where the summary had 47: sources are found again in all rows."""
    caplog.set_level("INFO", "gsparc")
    data, fold, _, _ = pillar
    found = ImageSources(EffectSettings(residual=False), None, InitSettings("rays"))
    said_before = []
    condition = ImageSources.condition

    def counted(self, *given):
        said_before.append("Gaussians from" in caplog.text)
        condition(self, *given)

    monkeypatch.setattr(ImageSources, "condition", counted)
    found.fit(data, fold, FitContext())
    assert said_before and not any(said_before)
    assert f"{found.count_gaussians} Gaussians from init=rays" in caplog.text


def test_rows_left_out_were_told_by_other_sources_than_answer():
    """Each group was triangulated anew: three fits more, whose errors were not those of this."""
    data, fold, _ = directed(100)
    method, _ = fitted(data, fold)
    places, kernel = method.posterior.positions.points, method.posterior.kernel
    part = np.sort(fold.learned())[::2]
    method.condition(data, part)
    assert method.posterior.positions.points is places and method.posterior.kernel is kernel
    assert set(method.left_out().rows.tolist()) == set(part.tolist())
    assert error(method, data, fold.test) < 0.1
    method.condition(data, np.sort(np.r_[part, fold.test[:1]]))
    assert method.posterior.positions.points is not places, "rays that nobody looked at"
