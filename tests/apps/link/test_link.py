"""Grids, beams, statistics and the export; with Sionna itself in the slow part."""

import json
import re
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from cities import city, fold, uplink_field
from doors import knock
from names import find_unexplained

from gsparc import load
from gsparc.apps.link.adaptation import CHUNK, Adaptation, Band, Rates
from gsparc.apps.link.pusch import Pusch, frequency_correlation
from gsparc.apps.link.run import true_channels
from gsparc.apps.link.study import (
    beam_gain,
    beam_loss_db,
    find_crossing,
    rate_facts,
)
from gsparc.commands.listing import COMMANDS
from gsparc.models import checkpoint
from gsparc.prediction.channels import centred_grid, interpolate_tones, resource_grid
from gsparc.processes.uncertainty import binomial_interval

needs_sionna = pytest.mark.skipif(
    find_spec("sionna") is None, reason="the extra `sionna` is not installed"
)


@pytest.fixture(autouse=True)
def _noise_repeats():
    """Sionna draws bits and noise from a generator of its own."""
    if find_spec("sionna") is not None:
        from sionna.phy import config

        config.seed = 0


def drawn():
    """`draw(*shape)`: complex normal numbers, the same in every test."""
    return partial(torch.randn, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    file = tmp_path_factory.mktemp("link") / "model.ckpt"
    checkpoint.save(file, uplink_field())
    return city("all"), file


def test_interpolation_hits_a_channel_it_was_not_shown() -> None:
    tones = 2.4e9 + 312.5e3 * np.arange(26)
    delays = np.array([0, 80e-9, 210e-9, 700e-9])
    gains = np.array([1, 0.6j, -0.4, 0.1 + 0.1j])

    def response(frequency):
        turns = np.outer(delays, frequency - 2.4e9)
        return torch.from_numpy((gains @ np.exp(-2j * np.pi * turns)).astype(np.complex64))[
            None, None
        ]

    wanted = centred_grid(float(tones.mean()), 30e3, 240)
    miss = interpolate_tones(response(tones), tones, wanted) - response(wanted)
    assert miss.abs().square().mean() < 1e-3 * response(wanted).abs().square().mean()
    with pytest.raises(ValueError, match="fewer blocks"):
        interpolate_tones(response(tones), tones, centred_grid(float(tones.mean()), 30e3, 2400))


def test_one_tone_is_flat() -> None:
    assert torch.equal(
        interpolate_tones(torch.ones(2, 1, 1), np.array([1e9]), np.arange(3.0)), torch.ones(2, 1, 3)
    )


@needs_sionna
@pytest.mark.parametrize("antennas", ["rx", "tx"])
@pytest.mark.parametrize("moves", ["rx", "tx"])
def test_sionna_applies_a_grid_of_arrays_at_either_end(moves: str, antennas: str) -> None:
    """A receiver's antennas landed on the transmitter's axis, and Sionna summed over them."""
    from sionna.phy.channel import ApplyOFDMChannel

    still = "tx" if moves == "rx" else "rx"
    site = SimpleNamespace(still_end=still, antenna_end=antennas)
    channel = drawn()(5, 2, 3, 6)  # places, stations, antennas, tones
    grid = resource_grid(channel, 14, site)  # type: ignore[arg-type]
    ends = {still: 2, moves: 1}
    sent = torch.ones(5, ends["tx"], 3 if antennas == "tx" else 1, 14, 6, dtype=torch.complex64)
    heard = ApplyOFDMChannel()(sent, grid)
    # Each receiver hears the sum over all that transmit
    sums = channel.sum(1, keepdim=True) if still == "tx" else channel
    sums = sums.sum(2, keepdim=True) if antennas == "tx" else sums
    assert heard.shape == (5, ends["rx"], 3 if antennas == "rx" else 1, 14, 6)
    assert torch.allclose(heard[:, :, :, 7], sums, atol=1e-5)


@needs_sionna
@pytest.mark.slow
def test_a_prediction_as_prior_is_worth_more_than_pilots_alone() -> None:
    """What examples/receiver.py prints: at 0 dB the place tells more, at 10 dB both together."""
    example = Path(__file__).parents[3] / "examples" / "receiver.py"
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, check=True)
    lines = re.findall(r"(\d+) dB  (\S.*?) +(-?[\d.]+) dB", done.stdout)
    error = {(int(snr), name): float(decibels) for snr, name, decibels in lines}
    both, alone = "prediction, then pilots", "pilots alone"
    assert error[0, both] < error[0, alone] - 5 and error[10, both] < error[10, alone] - 0.3
    assert error[10, both] < error[10, "prediction alone"] - 1


def test_beams_gain_the_number_of_antennas_and_lose_what_is_wrong() -> None:
    draw = drawn()
    true = draw(200, 16, 4)
    assert torch.allclose(beam_gain(true, true).mean(), torch.tensor(16.0), rtol=0.01)
    assert beam_loss_db(true, true * (2 - 1j)).abs().max() < 1e-4
    noise = draw(200, 16, 4)
    # Half of the beam's power is of no use: |h + e|^2 = 2 |h|^2.
    assert abs(float(beam_loss_db(true, true + noise).mean()) - 3.0) < 0.3


def test_where_nothing_can_be_carried_nothing_falls_short() -> None:
    """At -50 dB the oracle carries nothing: 0 / 0 ended the command after its work."""
    none = np.zeros(2)
    rates = Rates(-50.0, none, none, none, none, none, none + 1, none == 0, 0.0)
    facts = rate_facts([rates], np.array([True, False]))
    assert facts["mcs/-50dB/shortfall"] is None
    assert all(value is None or np.isfinite(value) for value in facts.values())


def test_crossing_and_intervals() -> None:
    assert np.isclose(find_crossing(pd.Series([1.0, 0.1, 0.01])), 1.0)
    assert find_crossing(pd.Series([1.0, 0.5, 0.2])) is None
    low, high = binomial_interval(10, 100)
    assert (
        low < 0.1 < high and binomial_interval(0, 10)[0] == 0 and binomial_interval(10, 10)[1] == 1
    )
    assert binomial_interval(0, 0) == (0, 1)


def test_truth_of_the_streets_is_in_the_snapshot_s_own_frame() -> None:
    """Recomputed rays, turned by offsets found on the uplink,
    equal the measured downlink up to its noise.
    """
    data = city("all")
    rows = fold().test
    exact, source = true_channels(data, rows, data.site.subcarriers_hz)
    miss = (exact - data.targets(rows)).abs().square().mean((1, 2))
    power = exact.abs().square().mean((1, 2))
    # Noise, and the tones a frequency offset leaks into one another.
    assert source == "rays" and (miss < 1.2 * float(data.noise_variance[0]) + 1e-3 * power).all()


def test_export_on_any_grid(trained) -> None:
    data, file = trained
    predictor = load(file)
    rows = fold().test[:2]
    heard = data.uplink[rows] * data.site.target_scale
    wanted = centred_grid(float(data.site.subcarriers_hz.mean()), 30e3, 48)
    slot = predictor.csi(uplink=heard, frequency_hz=wanted, symbols=14)
    assert slot.shape == (2, 1, 1, 1, 64, 14, 48) and slot.dtype == np.complex64
    tones = predictor.csi(uplink=heard)
    assert tones.shape == (2, 64, 26)
    exact, _ = true_channels(data, rows, wanted)
    miss = np.abs(slot[:, 0, 0, 0, :, 0] - exact.numpy() * data.site.target_scale) ** 2
    assert miss.mean() < 0.3 * np.mean(np.abs(exact.numpy() * data.site.target_scale) ** 2)
    found = predictor.paths(heard)
    assert found.gain.shape == found.delay_s.shape == (2, 16) and found.cosines.shape == (2, 16, 2)
    assert np.abs(found.delay_s).max() < 1 / 312.5e3
    with pytest.raises(ValueError, match=r"expected \(B, 64, 26\)"):
        predictor.csi(uplink=heard[:, :8])


@needs_sionna
@pytest.mark.slow
def test_without_doubt_the_choice_carries_most() -> None:
    draw = drawn()
    true = draw(40, 26)
    known = Band(true, true, torch.zeros(40))
    loop = Adaptation()
    same = loop.rates(known, 0.03, None)  # the paper's rule
    assert (same.chosen == same.oracle).all()
    found = loop.rates(known, 0.03, 1.0)
    assert np.allclose(found.chosen_bps, found.best_bps)
    assert found.oracle_bps.mean() > 5e6 and (found.best_bps >= found.oracle_bps).all()
    deaf = loop.rates(known, 1e4, 1.0)
    assert deaf.outage.all() and deaf.oracle_bps.max() < 1e6


@needs_sionna
def test_memory_of_rates_grew_with_the_positions(monkeypatch) -> None:
    """8,000 test rows of 42 antennas took all memory: error rates were of all at once."""
    draw, loop, sizes = drawn(), Adaptation(), list[int]()
    abstraction = loop.abstraction

    def watched(index, **arguments):
        sizes.append(len(index))
        return abstraction(index, **arguments)

    monkeypatch.setattr(loop, "abstraction", watched)
    true = draw(CHUNK + 3, 2)
    rates = loop.rates(Band(true, true, torch.full((len(true),), 0.1)), 0.03, 1.0)
    assert max(sizes) == CHUNK and len(rates.chosen) == len(true)


@needs_sionna
@pytest.mark.slow
def test_doubt_makes_the_choice_careful_and_carries_more() -> None:
    draw = drawn()
    true = draw(200, 1).expand(200, 26)
    error = draw(200, 1).expand(200, 26) * 0.2
    band = Band(true, true + error, torch.full((200,), 0.04))
    loop = Adaptation()
    bold, careful = (loop.rates(band, 0.01, care) for care in (0.0, 1.0))
    assert careful.chosen.mean() < bold.chosen.mean()
    assert bold.chosen_bps.mean() < careful.chosen_bps.mean() < careful.best_bps.mean()


@needs_sionna
@pytest.mark.slow
def test_pilots_mend_a_prediction_and_a_prediction_mends_pilots() -> None:
    draw = drawn()
    torch.manual_seed(0)
    true, error = draw(2, 16, 1).expand(2, 16, 48)
    share = 0.2
    guess, doubt = true + share**0.5 * true.abs() * error, share * true[:, 0].abs().square()
    known = frequency_correlation(true, np.array([1.0]), 30e3, 48)
    pusch = Pusch("qpsk", 4, 30, known, 8)
    band = Band(true.contiguous(), guess, doubt)
    wrong = pusch.run(band, 3.0, np.arange(256) % 16, 64).groupby("receiver").failed.mean()
    assert wrong["predicted_pilots"] < wrong["predicted"] - 0.05
    assert wrong["perfect"] - 0.02 <= wrong["predicted_pilots"] <= wrong["lmmse"] + 0.02
    # Without any doubt the pilots are not listened to, with all of it the prediction is not.
    sure, deaf = (
        pusch.receivers[name]._channel_estimator for name in ("predicted_pilots", "lmmse")
    )
    y = draw(4, 1, 1, 14, 48)
    pusch._prior = guess[:4], torch.zeros(4)
    assert torch.allclose(sure(y, torch.tensor(0.1))[0][:, 0, 0, 0, 0, 0], guess[:4], atol=1e-2)
    pusch._prior = torch.zeros(4, 48), torch.ones(4)
    assert torch.allclose(sure(y, torch.tensor(0.1))[0], deaf(y, torch.tensor(0.1))[0], atol=1e-5)


@needs_sionna
@pytest.mark.slow
def test_the_command_leaves_everything(trained, tmp_path, monkeypatch) -> None:
    data, file = trained
    module = SimpleNamespace(measurements=data)
    monkeypatch.setattr("gsparc.runs.open_runs.datamodule", lambda settings, trusted: module)
    monkeypatch.setattr("gsparc.runs.open_runs.split_for", lambda settings, found: _split())
    answer = knock(
        COMMANDS["link"].run,
        "link",
        [
            f"ckpt={file}",
            "pusch.ebno_db.qpsk=[3.0,4.0]",
            "pusch.ebno_db.qam16=[7.0]",
            "pusch.coarse=16",
            "pusch.fine=32",
            "pusch.batch=16",
            "pusch.iterations=4",
            "mcs.snr_db=[15]",
            "promise.limit_db=0",
            "promise.alpha=0.4",
            "promise.delta=0.4",
            "dataset.name=x",
            "split.name=y",
            f"hydra.run.dir={tmp_path}",
        ],
    )
    assert answer.status == 0, answer
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert {"mcs.png", "bler.png", "acceptance.png"} <= {p.name for p in tmp_path.iterdir()}
    assert facts["beams/64/gain_db"] > facts["beams/8/gain_db"]
    assert facts["pusch/qpsk/perfect/4dB/bler"] <= facts["pusch/qpsk/perfect/3dB/bler"]
    assert facts["pusch/truth"] == "rays" and 0 <= facts["tradeoff/qpsk/predicted/100%"] <= 1
    assert find_unexplained(tmp_path) == []
    found = {key: value for key, value in facts.items() if key.endswith("/ebno_at_bler_0.1")}
    crossed = any(
        value is not None for key, value in found.items() if key.startswith("pusch/qpsk/")
    )
    assert crossed != any(line.startswith("qpsk: no curve") for line in answer.out)


@needs_sionna
@pytest.mark.slow
def test_a_threshold_by_hand_the_paper_s_rule_and_receivers(trained, tmp_path, monkeypatch) -> None:
    """Where no curve crosses 10 % a table without columns stood there."""
    monkeypatch.setattr(
        "gsparc.runs.open_runs.datamodule",
        lambda settings, trusted: SimpleNamespace(measurements=trained[0]),
    )
    monkeypatch.setattr("gsparc.runs.open_runs.split_for", lambda settings, found: _split())
    words = [
        f"ckpt={trained[1]}",
        "pusch.ebno_db.qpsk=[9.0]",
        "pusch.ebno_db.qam16=[]",
        "pusch.coarse=16",
        "pusch.fine=16",
        "pusch.iterations=4",
        "mcs.snr_db=[15]",
        "threshold=0.59",
        "rule=target",
        "receivers=[perfect,ls,lmmse,predicted]",
        "dataset.name=x",
        "split.name=y",
        f"hydra.run.dir={tmp_path}",
    ]
    answer = knock(COMMANDS["link"].run, "link", words)
    assert answer.status == 0, answer
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert (
        facts["threshold"] == 0.59
        and "promise/bound" not in facts
        and facts["mcs/15dB/care"] is None
    )
    assert {"ls", "lmmse"} < {key.split("/")[2] for key in facts if key.startswith("pusch/qpsk/")}
    assert any(line.startswith("qpsk: no curve crosses 10 %") for line in answer.out)
    assert not any("behind" in line for line in answer.out)
    assert find_unexplained(tmp_path) == []
    for wrong, message in (
        ("receivers=[perfect]", "predicted must be among"),
        ("rule=best", "rule='best'"),
    ):
        refused = knock(
            COMMANDS["link"].run, "link", [*words, wrong, f"hydra.run.dir={tmp_path / 'no'}"]
        )
        assert refused.status == 1 and message in refused.err[-1]


def _split():
    from gsparc.data.splits import Split

    one = fold()
    whole = type(one)(one.train[:40], one.val, np.concatenate([np.arange(40, 80), one.test]))
    return Split("toy", (whole,))
