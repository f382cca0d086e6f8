"""The closed-form field of complex channels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from closed import conditioned, fitted_to
from rooms import WAVELENGTH, shoebox
from scenes import answer_error

from gsparc.data.splits import Fold
from gsparc.models.channels import evidence
from gsparc.models.channels.columns import SlotPlaces, coherent_bands, group_channels
from gsparc.models.channels.complex_gp import ComplexGP
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.channels.kernels import (
    directional_correlation,
    fibonacci_sphere,
    number_cells_by_bisection,
)
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import (
    Direct,
    Directions,
    Drift,
    Images,
    Isotropic,
    Leakage,
    Noise,
)
from gsparc.models.channels.terms.term import Frame
from gsparc.processes.left_out import rows_of_groups
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

PLAIN = ChannelSettings(constant=False, direct=False, directions=False, correlated=False)
K = 2 * np.pi / WAVELENGTH
END = np.array([0.4, -0.3, 1.5])


def _sent(count=90, *, seed=0, direct=1.0, leakage=0.5, diffuse=0.0, noise=0.05, side=0.6, end=END):
    """Receivers in a flat patch, a transmitter at `END`: direct wave, leakage,
    plane waves and noise.
    """
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(0, side, (count, 2)), np.full(count, 0.2)]
    away = np.linalg.norm(place - end, axis=1)
    h = direct * np.exp(-1j * K * away) / away + leakage * np.exp(0.7j)
    waves = fibonacci_sphere(200).numpy()
    gains = rng.standard_normal((200, 2)) @ [1, 1j] * diffuse / 20
    h = h + np.exp(1j * K * place @ waves.T) @ gains
    h = h + noise * rng.standard_normal((count, 2)) @ [1, 1j] / 2**0.5
    arrays = {"rx_position": place, "tx_position": END, "csi": h, "carrier_hz": np.array(2.4e9)}
    return from_arrays({**arrays, "frequency_hz": np.array([2.4e9])})


def _prior(data, *, correlated=False, mirrors=1, angles=4, envelope=0.4):
    """Every term."""
    frame = Frame(
        torch.from_numpy(data.moving).mean(0),
        20.0,
        envelope,
        0.3,
        torch.tensor([0.01, -0.02, 0.0]).double(),
    )
    # Beneath everything
    planes = torch.tensor([[0.1, 0.0, 1.0, -0.7]], dtype=torch.float64)[:mirrors]
    sizes = [1, angles, 1, 2, 2 * mirrors, 1, 2 * correlated]
    power = torch.rand(sum(sizes), dtype=torch.float64, generator=torch.manual_seed(0)) + 0.2
    isotropic, unequal, leakage, direct, images, noise, drift = power.split(sizes)
    return ChannelPrior(()).with_terms(
        Isotropic(frame, isotropic),
        Directions(frame, unequal, angles=fibonacci_sphere(angles), concentration=5.0),
        Leakage(frame, leakage),
        Direct(frame, direct),
        Images(frame, images, planes=planes),
        Noise(frame, noise),
        Drift(frame, drift),
    )


def _whole(data, **terms):
    """A field with every term, on the first 40 rows."""
    return conditioned(_prior(data, **terms), data, np.arange(40))


def _signal(prior, a, b):
    return next(prior.end_covariances([a], [b]))


def test_isotropic_term_alone_is_the_plain_process():
    _, data, fold = shoebox(200, size=(0.7, 0.6, 0.6), max_order=1)
    plain = ComplexGP()
    plain.fit(data, fold, FitContext())
    field, notes = fitted_to(ChannelField(PLAIN), data, np.concatenate([fold.train, fold.val]))
    assert field.terms == ("residual",) and field.count_gaussians == 0
    if "kept" in notes[1]:  # powers beside the grid's
        powers = torch.tensor([[1.0], [plain.kernel.noise]]).double()
        terms = zip(field.prior.terms, powers, strict=True)
        field.prior = ChannelPrior(tuple(replace(term, power=power) for term, power in terms))
        field.condition(data, np.concatenate([fold.train, fold.val]))
    batch = data.batch(fold.test)
    before, after = plain.predict(batch), field.predict(batch)
    torch.testing.assert_close(after.mean, before.mean, rtol=1e-4, atol=1e-4)
    # Its power is the targets' mean square, the field's is that of largest likelihood.
    level = field.weights[0].scale * (1 + plain.kernel.noise) / plain.kernel.amplitude
    torch.testing.assert_close(after.variance, before.variance * level, rtol=2e-3, atol=1e-6)
    torch.testing.assert_close(1 - after.unknown, before.confidence, rtol=2e-3, atol=1e-4)
    left, _ = plain.posterior.left_out_residuals()
    own = torch.from_numpy(data.target[field.rows]) - field.left_out().mean
    torch.testing.assert_close(own.flatten(), left.flatten().to(own.dtype), rtol=1e-3, atol=1e-4)


def test_one_direction_is_the_mean_of_plane_waves_and_all_are_the_isotropic_field():
    step = torch.randn(200, 3, dtype=torch.float64) * 0.2
    distance = step.norm(dim=1)
    found = torch.stack(
        [
            directional_correlation((K * distance) ** 2, K * step @ u, 8.0)
            for u in fibonacci_sphere(96)
        ]
    ).mean(0)
    torch.testing.assert_close(found.real, torch.sinc(distance * K / np.pi), atol=2e-3, rtol=0)
    assert found.imag.abs().max() < 2e-3
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    step, waves = torch.randn(50, 3, dtype=torch.float64) * 0.1, fibonacci_sphere(40_000)
    weight = torch.softmax(6.0 * waves @ direction, 0)
    expected = torch.polar(torch.ones(()).double(), K * step @ waves.T) @ weight.to(
        torch.complex128
    )
    found = directional_correlation((K * step.norm(dim=1)) ** 2, K * step @ direction, 6.0)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_slopes_of_the_evidence_and_what_compression_costs():
    data = _sent(120, diffuse=1.0, side=0.3)
    prior = _prior(data, envelope=2.0)
    groups = tuple(map(evidence.normalise_power, group_channels(data, np.arange(120), True)))
    part = evidence.compress_groups(groups, prior)[0]
    power = part.powers(prior)
    assert part.basis.shape[1] < 80
    at = evidence.solve_group(part, power)
    slope = evidence.power_gradient(part, power, at)
    for number in range(len(power)):
        found = [
            evidence.solve_group(
                part, power * torch.exp(step * torch.eye(len(power)).double()[number])
            ).nll
            for step in (1e-5, -1e-5)
        ]
        assert float(slope[number]) == pytest.approx(
            (found[0] - found[1]) / 2e-5, rel=1e-4, abs=1e-4
        )
    group = groups[0]
    whole = prior.signal_covariances(groups)[0] + prior.disturbance(group)
    fit = (group.target.conj() * torch.linalg.solve(whole, group.target)).real.mean()
    expected = float(len(group) * fit.log() + torch.logdet(whole).real)
    assert at.nll == pytest.approx(expected, abs=1.0)
    cell = number_cells_by_bisection(group.places.numpy(), 3)
    (error,), inverse = (
        evidence.left_out_errors(part, power, [rows_of_groups(cell)]),
        torch.linalg.inv(whole),
    )
    mine = torch.from_numpy(np.flatnonzero(cell == 2))
    own = torch.linalg.solve(inverse[mine[:, None], mine], (inverse @ group.target)[mine])
    assert (error[mine] - own).abs().max() < 0.03 * own.abs().max()


@pytest.mark.parametrize("correlated", [False, True])
def test_left_out_is_what_refitting_gives(correlated):
    data = _sent(60, diffuse=0.5)
    field = _whole(data, correlated=correlated)
    left = field.left_out()
    for row in (0, 7, 23):
        again = _whole(data, correlated=correlated)
        rest = np.delete(np.arange(40), row)
        again.condition(data, rest)
        batch = data.batch(np.array([row]))
        with torch.no_grad():
            found = again.predict(batch)
        torch.testing.assert_close(found.mean[0], left.mean[row], rtol=1e-3, atol=1e-4)
        scale = field.weights[0].scale / again.weights[0].scale
        # A row's drift is also that of rows before and after it, which no query's is.
        near = 0.1 if correlated else 1e-3
        torch.testing.assert_close(
            found.variance[0] * scale, left.variance[row], rtol=near, atol=1e-6
        )


@pytest.mark.parametrize("noise", [0.1, 1e-9])
@pytest.mark.parametrize("plain", [False, True])
def test_variances_have_the_digits_they_need(noise, plain):
    data, dtype = _sent(60), torch.float64 if noise < 1e-3 else torch.float32
    prior = _prior(data, mirrors=0, angles=0 if plain else 4)
    prior = prior.with_terms(replace(prior[Noise], power=torch.full((1,), noise).double()))
    if plain:
        prior = prior.with_terms(replace(prior[Direct], power=torch.zeros(0).double()))
    (known,) = conditioned(prior, data, np.arange(40)).weights
    here = SlotPlaces(known.group.slot, torch.from_numpy(data.moving[30:50]).double())
    cross = _signal(prior, here, known.group)
    white = torch.linalg.solve_triangular(known.given.factor.lower, cross.mH, upper=False)
    exact = white.abs().square().sum(0)
    assert known.root.dtype == (dtype if plain else dtype.to_complex())
    assert (known.explained_variance(cross) - exact).abs().max() < 2e-3 * noise + 1e-10


def test_directions_in_blocks_are_those_at_once(monkeypatch):
    data = _sent(60)
    (group,), term = group_channels(data, np.arange(40), True), _prior(data)[Directions]
    whole = term.covariance(group, group)
    monkeypatch.setattr("gsparc.models.channels.terms.directions.ENTRIES", 1)
    torch.testing.assert_close(term.covariance(group, group), whole)


def test_leakage_and_direct_wave_are_found_where_they_are():
    without, _ = fitted_to(
        ChannelField(), _sent(90, direct=0.0, leakage=0.0, diffuse=1.0), np.arange(90)
    )
    assert "direct" not in without.terms
    data = _sent(120, diffuse=0.3)
    field, notes = fitted_to(ChannelField(ChannelSettings(directions=False)), data, np.arange(60))
    assert {"leakage", "direct"} <= set(field.terms)
    assert any(note.startswith("waves: leakage and direct wave kept") for note in notes)
    plain, none, test = ComplexGP(), np.zeros(0, np.int64), np.arange(60, 120)
    plain.fit(data, Fold(np.arange(60), none, none), FitContext())
    assert answer_error(field, data, test) < 0.7 * answer_error(plain, data, test)


def test_a_static_end_that_stands_elsewhere_is_found():
    moved = END + np.array([0.05, -0.03, 0.0])
    data = _sent(150, leakage=0.0, diffuse=0.2, end=moved, side=1.2)
    field, _ = fitted_to(
        ChannelField(ChannelSettings(directions=False, correlated=False)), data, np.arange(150)
    )
    assert "direct" in field.terms
    np.testing.assert_allclose(field.prior.frame.offset[:2], (moved - END)[:2], atol=0.02)


def test_an_array_that_stands_still_and_one_that_moves():
    rng = np.random.default_rng(0)
    place, end = rng.uniform(0, 0.5, (80, 3)), np.array([1.0, 0.3, 1.2])
    array = np.c_[np.arange(3) * WAVELENGTH / 2, np.zeros((3, 2))]
    common = {"array_position": array, "frequency_hz": np.array([2.4e9])}
    for moving, static, name in (("tx", "rx", "static"), ("rx", "tx", "moving")):
        elements = (end + array)[None] if static == "rx" else place[:, None] + array
        away = np.linalg.norm((place[:, None] if static == "rx" else end) - elements, axis=-1)
        h = (np.exp(-1j * K * away) / away)[..., None]
        arrays = {f"{moving}_position": place, f"{static}_position": end, "csi": h, **common}
        data = from_arrays(arrays)
        field, _ = fitted_to(ChannelField(ChannelSettings(directions=False)), data, np.arange(50))
        assert "direct" in field.terms, name
        assert len(field.weights) == 3
        assert answer_error(field, data, np.arange(50, 80)) < 0.01, name


@pytest.mark.parametrize("count", [1, 2, 3])
def test_channels_of_two_rows_were_divided_by_no_row(count):
    """All were of one fold, without which powers of directions are found."""
    data = _sent(12)
    field, rows = ChannelField(), np.arange(count)
    field.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext())
    assert torch.isfinite(torch.view_as_real(field.predict(data.batch(np.arange(12))).mean)).all()


def test_channels_of_no_known_carrier_are_refused():
    data = _sent(12)
    unknown = replace(data, site=replace(data.site, carrier_hz=None))
    with pytest.raises(ValueError, match="known carrier"):
        fitted_to(ChannelField(), unknown, np.arange(12))


def test_tones_far_apart_are_bands_of_their_own():
    tones = 2.4e9 + 1e6 * np.arange(40)
    found = coherent_bands(tones, 10.0)
    assert len(coherent_bands(tones, 0.1)) == 1 and len(found) > 4
    assert sorted(sum(found, ())) == list(range(40))
