"""The verdict on phases: packets with phases of their own are told, coherent channels never are."""

import logging
from dataclasses import replace

import numpy as np
import packets
import pytest

from gsparc.base.limits import SettingError
from gsparc.tables.checks.coherence import estimate_coherence, set_unknown_factor
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw


@pytest.mark.parametrize("layout", ["los", "nlos"])
@pytest.mark.parametrize("labelled", [True, False])
def test_packets_of_a_robot_are_told_with_and_without_its_runs(layout, labelled):
    for transmitter in range(3):
        given, channel = packets.robot(transmitter, 10 * transmitter, layout)
        tones = given["frequency_hz"] - given["frequency_hz"].mean()
        coherent = estimate_coherence(packets.measurements(given, channel))
        assert coherent is not None and coherent.unknown_factor == "none"
        if not labelled:
            del given["run"]
        logged = packets.measurements(given, packets.logged(channel, tones, 0))
        assert estimate_coherence(logged).unknown_factor == "phase+delay"
        turned = packets.logged(channel, 0 * tones, 0)
        assert estimate_coherence(packets.measurements(given, turned)).unknown_factor.startswith(
            "phase"
        )
        if not labelled:  # millimetres apart
            louder = packets.measurements(given, packets.logged(channel, tones, 0, 6.0))
            assert estimate_coherence(louder).unknown_factor == "phase+delay+gain"


def waves(seed, noise=0.0, spacing=0.03):
    """Ten plane waves at 20 tones along a grid of 12 x 12 places."""
    draw, tones = np.random.default_rng(seed), 2.4e9 + 1e6 * np.arange(20)
    places = np.c_[
        np.stack(np.meshgrid(*2 * [spacing * np.arange(12)]), -1).reshape(-1, 2), np.ones(144)
    ]
    towards = draw.standard_normal((10, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    path = places @ towards.T + draw.uniform(5, 30, 10)
    gain = draw.standard_normal(10) + 1j * draw.standard_normal(10)
    channel = (gain * np.exp(-2j * np.pi / 299792458 * path[:, None] * tones[:, None])).sum(-1)
    channel += noise * (
        draw.standard_normal(channel.shape) + 1j * draw.standard_normal(channel.shape)
    )
    station = np.array([9.0, 9, 3])
    given = {"rx_position": places, "tx_position": station, "csi": channel, "frequency_hz": tones}
    return interpret(Raw(given, {}), "waves").data


@pytest.mark.parametrize("spacing", [0.01, 0.03, 0.05, 0.08])
def test_no_false_alarm_on_coherent_waves(spacing):
    for seed in range(5):
        for noise in (0.0, 0.5, 3.0):
            found = estimate_coherence(waves(seed, noise, spacing))
            assert found is None or found.unknown_factor == "none", (seed, noise, str(found))


def test_the_setting_wins_over_the_verdict(caplog):
    data = waves(0)
    assert set_unknown_factor(data, "auto") is data
    assert set_unknown_factor(data, "phase").site.unknown_factor == "phase"
    draw = np.random.default_rng(0)
    turn = np.exp(2j * np.pi * draw.uniform(size=len(data)))
    own = replace(data, target=(data.target * turn[:, None, None]).astype(np.complex64))
    with caplog.at_level(logging.WARNING):
        assert set_unknown_factor(own, "auto").site.unknown_factor == "phase"
    assert "every row has a phase of its own" in caplog.text and "dataset.align=none" in caplog.text
    assert set_unknown_factor(own, "none").site.unknown_factor == "none"
    with pytest.raises(SettingError, match=r"dataset\.align='level'"):
        set_unknown_factor(data, "level")


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_rows_without_power_divided_by_zero():
    data = waves(0)
    data.target[:30] = 0
    assert estimate_coherence(data).unknown_factor == "none"
