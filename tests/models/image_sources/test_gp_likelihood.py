"""The two processes against brute force: covariance, leave-one-out, gradients,
and each against the other.
"""

import pytest
import torch
from gains import gains, phased

from gsparc.models.image_sources import refine
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.query import EnsembleMeans
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene, spherical_waves
from gsparc.processes.matern import matern32_of_squares

COUNT = 24


def _rows(outputs: int = 1) -> Rows:
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(COUNT, 3, generator=generator, dtype=torch.float64) * 3
    position[1] = position[0]  # one place, two tones
    frequency = torch.full((COUNT,), 2.4e9, dtype=torch.float64)
    frequency[1] = 2.41e9
    receiver = torch.arange(COUNT)
    receiver[1] = 0
    target = torch.randn(COUNT, outputs, generator=generator, dtype=torch.complex64)
    return Rows(position, frequency, target, receiver)


def _scene() -> SourceScene:
    return SourceScene(
        transmitter=torch.tensor([4.0, 1.0, 1.0], dtype=torch.float64),
        planes=torch.tensor([[1.0, 0, 0, -1], [0, 1, 0.1, 4]], dtype=torch.float64),
        sequences=((), (0,), (0, 1)),
        log_amplitude=torch.tensor([0.5, 0.2, -0.1]),
        log_noise=-1.0,
        visibility=KernelVisibility(0.7, 0.6, 1.5),
    )


def _phased(quadrature: float = 0.2) -> SourceScene:
    return phased(_scene(), torch.tensor([0.3, -1.0, 2.0]), quadrature)


def test_covariance_by_the_formula():
    rows, scene = _rows(), _scene()
    waves = spherical_waves(rows, scene.sources)
    expected = torch.eye(COUNT, dtype=torch.complex64) * (torch.tensor(-1.0).exp() + 1e-5)
    for k, source in enumerate(scene.sources):
        correlation = scene.visibility.correlation(rows.position, source)
        wave = waves[:, k] * scene.log_amplitude[k].exp()
        expected = expected + wave[:, None] * wave.conj() * correlation
    torch.testing.assert_close(
        GainPosterior(rows, scene).covariance, expected, rtol=1e-5, atol=1e-5
    )


def test_without_a_source_is_the_scene_less_that_source_and_its_plane():
    rows, less = _rows(), _scene().select_sources([0, 1])
    assert GainPosterior(rows, _scene()).nll_without_source(2) == pytest.approx(
        GainPosterior(rows, less).nll, rel=1e-5
    )
    assert less.sequences == ((), (0,)) and len(less.planes) == 1


@pytest.mark.parametrize("quadrature", [0.1, 1.0])
def test_left_out_by_refitting_without_the_receiver(quadrature):
    rows, scene = _rows(), _phased(quadrature)
    left_out = GainPosterior(rows, scene).predict_left_out()
    for receiver in (0, 5):  # the first has two rows
        mine = rows.receiver == receiver
        rest = GainPosterior(rows.select_rows(torch.nonzero(~mine)[:, 0]), scene)
        held = rows.select_rows(torch.nonzero(mine)[:, 0])
        waves = spherical_waves(held, scene.sources)
        predicted = (waves[:, :, None] * gains(rest, held.position)).sum(1)
        torch.testing.assert_close(left_out[mine], predicted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("make", [_scene, _phased])
def test_slopes_of_the_likelihood_which_refining_raises(make):
    rows, scene = _rows(), make()
    seen = torch.stack(
        [scene.visibility.correlation(rows.places, source) for source in scene.sources]
    )
    values = [scene.transmitter, *scene.planes.split((3, 1), 1), scene.log_amplitude]
    values += [torch.tensor(scene.log_noise)]
    values += [] if scene.phase is None else [scene.phase]
    nll, gradient = refine._cost_and_gradient(rows, scene, values, seen)
    assert nll == pytest.approx(GainPosterior(rows, scene).nll, rel=1e-5)
    for i, value in enumerate(values):
        step = 3e-4 if i < 3 else 2e-2
        for j in range(min(value.numel(), 4)):
            ends = []
            for sign in (1, -1):
                moved = [v.clone() for v in values]
                moved[i].view(-1)[j] += sign * step
                ends.append(refine._cost_and_gradient(rows, scene, moved, seen)[0])
            numeric = (ends[0] - ends[1]) / (2 * step)
            assert gradient[i].reshape(-1)[j].item() == pytest.approx(
                numeric, rel=0.05, abs=0.15
            ), (i, j)
    assert GainPosterior(rows, refine.refine_scene(rows, scene, 8)).nll < nll


def test_variance_is_that_of_the_joint_gaussian():
    """Schur complement of the covariance of rows and query together."""
    rows, scene = _rows(), _phased()
    query = torch.tensor([[1.0, 1.2, 0.4]], dtype=torch.float64)
    tone = torch.tensor([2.4e9], dtype=torch.float64)
    _, variance, _ = EnsembleMeans([GainPosterior(rows, scene)]).predict(query, tone)
    both = Rows(
        torch.cat([rows.position, query]),
        torch.cat([rows.frequency, tone]),
        torch.cat([rows.target, torch.zeros(1, 1, dtype=torch.complex64)]),
        torch.arange(COUNT + 1),
    )
    inverse = GainPosterior(both, scene).conditioned.factor.inverse
    block = inverse[[COUNT, 2 * COUNT + 1]][:, [COUNT, 2 * COUNT + 1]]
    assert variance.item() == pytest.approx(torch.linalg.inv(block).trace().item(), rel=1e-3)
    _, less, prior = EnsembleMeans([GainPosterior(rows, scene)], 10).predict(query, tone)
    assert variance - 1e-5 <= less <= prior  # fewer rows know less


@pytest.mark.parametrize("extent", [5.0, 500.0, 20_000.0])
def test_visibility_of_a_wide_site_is_a_covariance(extent):
    """Expanded squares of places in float32:
    off by 0.2 of 1 and no covariance in a site of 20 km.
    """
    draws = torch.Generator().manual_seed(0)
    places = (torch.rand(200, 3, generator=draws, dtype=torch.float64) - 0.5) * extent
    places[100:] = places[:100] + 0.01 * torch.randn(100, 3, generator=draws, dtype=torch.float64)
    law, source = KernelVisibility(), torch.tensor([0.7 * extent, 1.0, 2.0], dtype=torch.float64)
    found = law.correlation(places, source)
    rays = (places - source) / (places - source).norm(dim=1, keepdim=True)
    squared = (rays[:, None] - rays).square().sum(-1) / law.angle**2
    squared = squared + (places[:, None] - places).square().sum(-1) / law.length**2
    exact = law.constant + (1 - law.constant) * matern32_of_squares(squared)
    # 1 at the same place
    assert found.dtype == torch.float32 and (found - exact).abs().max() < 1e-5
    assert torch.linalg.eigvalsh(found.double()).min() > -1e-5
