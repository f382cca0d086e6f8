"""Mirror planes that several static ends share: found by all,
and of use to one that was never heard.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from closed import fitted_to
from rooms import WAVELENGTH, nmse
from scenes import answer_error, fold_of

from gsparc.data.query import Query
from gsparc.models.channels.columns import group_channels
from gsparc.models.channels.evidence import compress_groups, normalise_power
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.probe import Probe, likelihood_gains
from gsparc.models.channels.terms import Direct, Images, Isotropic, Noise
from gsparc.models.channels.terms.term import Frame
from gsparc.ops import Pose
from gsparc.physics.mirror_planes import reflect
from gsparc.processes.worker import Cancelled, cancel_when
from gsparc.simulate.shoebox import Room, mirror_images
from gsparc.tables.own import from_arrays

K = 2 * np.pi / WAVELENGTH
WALL = np.array([np.cos(0.3), np.sin(0.3), 0.0, 2.1])  # no axis of the room


def _channels(ends, places, walls, *, turned=0.0, noise=0.03, seed=0):
    """Direct waves and images in walls (W, 4), each with a loss of 4 dB."""
    rng = np.random.default_rng(seed)
    channel = np.zeros((len(places), len(ends)), complex)
    for number, end in enumerate(ends):
        for wall, gain in ((None, 1.0), *((wall, -0.63) for wall in walls)):
            at = (
                end
                if wall is None
                else reflect(torch.from_numpy(end), torch.from_numpy(wall)).numpy()
            )
            away = np.linalg.norm(places - at, axis=1)
            channel[:, number] += gain * np.exp(-1j * K * away) / away
        channel[:, number] *= np.exp(1j * turned * rng.standard_normal())
    size = np.sqrt((np.abs(channel) ** 2).mean())
    return channel + noise * size * (rng.standard_normal((*channel.shape, 2)) @ [1, 1j])


def _site(walls, *, ends=5, count=70, side=0.5, **rest):
    rng = np.random.default_rng(3)
    end = np.c_[rng.uniform(-1, 1.2, (ends, 2)), rng.uniform(1.0, 1.8, ends)]
    place = np.c_[rng.uniform(0, side, (count, 2)), rng.uniform(0.3, 0.5, count)]
    return end, place, _channels(end, place, walls, **rest)


def _data(end, place, channel, carrier=299792458.0 / WAVELENGTH):
    carrier = np.array(carrier)
    arrays = {"tx_position": place, "station_position": end, "csi": channel, "carrier_hz": carrier}
    return from_arrays({**arrays, "frequency_hz": carrier[None]})


def _bare(data):
    """Groups, and a direct wave in a diffuse field."""
    groups = tuple(
        normalise_power(group) for group in group_channels(data, np.arange(len(data)), True)
    )
    frame = Frame(torch.from_numpy(data.moving).mean(0), 20.0, 2.0, 0.8, torch.zeros(3).double())
    power = torch.tensor([0.3, 0.5, 0.02, 0.01], dtype=torch.float64)
    terms = Isotropic(frame, power[:1]), Direct(frame, power[1:3]), Noise(frame, power[3:])
    return groups, ChannelPrior(terms)


def test_a_probe_gains_what_the_likelihood_rises():
    groups, prior = _bare(_data(*_site([WALL], ends=1)))
    group, level = groups[0], 0.2
    probe = Probe.from_group(compress_groups(groups, prior)[0], prior)
    covariance = prior.signal_covariances(groups)[0] + prior.disturbance(group)
    waves = torch.randn(2, len(group), dtype=torch.complex128, generator=torch.manual_seed(0))
    for _ in range(2):  # alone, then beside the first
        for wave, gain in zip(waves, probe.likelihood_gain(waves, level), strict=True):
            more = covariance + level * wave[:, None] * wave.conj()[None]
            fits = [
                (group.target.mH @ torch.linalg.solve(c, group.target)).real.sum()
                for c in (covariance, more)
            ]
            sizes = [torch.linalg.slogdet(c)[1] for c in (covariance, more)]
            rise = (fits[0] - fits[1]) / probe.scale + sizes[0] - sizes[1]
            torch.testing.assert_close(gain, rise, rtol=1e-4, atol=1e-3)
        covariance = covariance + level * waves[0][:, None] * waves[0].conj()[None]
        probe = probe.add_wave(waves[0], level)


def test_no_wall_is_kept_where_there_is_none():
    data = _data(*_site([], ends=4, count=50, side=0.4, turned=2.0))
    field, _ = fitted_to(
        ChannelField(ChannelSettings(mirrors=2, directions=False)), data, np.arange(len(data))
    )
    assert field.prior.find_term(Images) is None and not len(field.objects().planes)


@pytest.mark.slow
def test_walls_of_a_room_are_found_together_and_serve_an_antenna_never_heard():
    rng, size, carrier = np.random.default_rng(0), (6.0, 4.0, 2.6), 920e6
    wavenumber = 2 * np.pi * carrier / 299792458.0
    place = np.c_[rng.uniform(1.5, 4.5, 110), rng.uniform(1, 3, 110), rng.uniform(0.8, 1.1, 110)]
    end = np.c_[rng.uniform(0.4, 5.6, 12), rng.uniform(0.4, 3.6, 12), np.full(12, 2.3)]
    mirror = mirror_images(Room.from_size(size, -0.6), 2)
    away = np.linalg.norm(place[:, None, None] - mirror.mirror_points(end)[None], axis=-1)
    channel = (np.exp(-1j * wavenumber * away) / away) @ mirror.gain
    heard = np.arange(9)
    data = _data(end[heard], place, channel[:, heard], carrier)
    fold = fold_of(data)
    rows = np.concatenate([fold.train, fold.val])
    errors, unheard = [], []
    for mirrors in (0, 8):
        field, _ = fitted_to(ChannelField(ChannelSettings(mirrors=mirrors)), data, rows)
        errors.append(answer_error(field, data, fold.test))
        with torch.no_grad():
            own = []
            for number in (9, 10, 11):
                where = torch.from_numpy(end[number] - data.site.origin).expand(len(place), 3)
                turned = torch.eye(3).expand(len(place), 3, 3)
                moving = torch.from_numpy(place - data.site.origin)
                told_of = field.predict(Query(moving, Pose(where, turned))).mean.reshape(-1).numpy()
                true = channel[:, number]
                scale = np.vdot(told_of, true) / np.vdot(told_of, told_of).real
                own.append(nmse(scale * told_of, true))
            unheard.append(np.mean(own))
    assert errors[1] < 0.5 * errors[0]
    assert unheard[1] < 0.5 * unheard[0]
    assert len(field.objects().planes) >= 4


def test_blocks_of_candidates_did_not_look_at_the_clock():
    """A search for where the static end is took a third of what followed the end of the seconds."""
    probes = [SimpleNamespace(group=range(5))]
    with cancel_when(lambda: True), pytest.raises(Cancelled):
        likelihood_gains(probes, 7, lambda *unused: pytest.fail("a block"), (1.0,))
