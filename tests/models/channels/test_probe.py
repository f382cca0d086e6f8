"""What one more wave would gain is what the likelihood rises by."""

import numpy as np
import torch

from gsparc.data.own import from_arrays
from gsparc.models.channels.columns import gather
from gsparc.models.channels.evidence import compressed, normalised
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.probe import Probe
from gsparc.models.channels.terms import Direct, Isotropic, Noise
from gsparc.models.channels.terms.term import Frame


def test_a_probe_gains_what_the_likelihood_rises():
    rng, level = np.random.default_rng(3), 0.2
    place = np.c_[rng.uniform(0, 0.5, (70, 2)), rng.uniform(0.3, 0.5, 70)]
    away = np.linalg.norm(place - [0.4, -0.3, 1.5], axis=1)
    channel = np.exp(-16j * np.pi * away) / away + 0.1 * rng.standard_normal((70, 2)) @ [1, 1j]
    data = from_arrays({
        "tx_position": place, "rx_position": np.array([0.4, -0.3, 1.5]), "csi": channel,
        "carrier_hz": np.array(2.4e9), "frequency_hz": np.array([2.4e9]),
    })  # fmt: skip
    groups = tuple(normalised(group) for group in gather(data, np.arange(70), True))
    frame = Frame(torch.from_numpy(data.moving).mean(0), 20.0, 2.0, 0.8, torch.zeros(3).double())
    power = torch.tensor([0.3, 0.5, 0.02, 0.01], dtype=torch.float64)
    prior = ChannelPrior((Isotropic(frame, power[:1]), Direct(frame, power[1:3]), Noise(frame, power[3:])))
    group, probe = groups[0], Probe.of(compressed(groups, prior)[0], prior)
    covariance = prior.of_groups(groups)[0] + prior.disturbance(group)
    waves = torch.randn(2, len(group), dtype=torch.complex128, generator=torch.manual_seed(0))
    for wave, gain in zip(waves, probe.gain(waves, level), strict=True):
        both = (covariance, covariance + level * wave[:, None] * wave.conj()[None])
        fits = [(group.target.mH @ torch.linalg.solve(c, group.target)).real.sum() for c in both]
        sizes = [torch.linalg.slogdet(c)[1] for c in both]
        rise = (fits[0] - fits[1]) / probe.scale + sizes[0] - sizes[1]
        torch.testing.assert_close(gain, rise, rtol=1e-4, atol=1e-3)
