"""A file of packets with phases of their own, through check, train and the answers of a model."""

import logging

import campaigns
import numpy as np
import packets
import pytest

import gsparc
from gsparc.commands.train import train
from gsparc.physics.row_factors import alignment_factors

pytestmark = pytest.mark.skipif(not packets.FOLDER.exists(), reason="../shared/data is not here")


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """A file of 300 packets, and the same coherent."""
    folder = tmp_path_factory.mktemp("packets")
    given, channel = packets.robot()
    tones = given["frequency_hz"] - given["frequency_hz"].mean()
    np.savez(folder / "coherent.npz", **given, csi=channel.astype(np.complex64))
    del given["run"]
    np.savez(folder / "logged.npz", **given, csi=packets.logged(channel, tones, 0).astype(np.complex64))
    return folder


def test_a_default_run_is_ahead_of_every_plain_method(logged, tmp_path):
    config = campaigns.compose(
        "dataset=own", f"dataset.file={logged / 'logged.npz'}", "model=gsparc", "logger=none"
    )
    facts, objects = train(config, tmp_path)
    assert facts["dataset/kind"] == "aligned csi" and facts["dataset/freedom"] == "phase+delay"
    assert facts["test/nmse_aligned"] < 0.05 and facts["test/tone_rmse_db"] < 2.6  # at random, seed 0
    for name in ("mean", "nearest", "idw"):
        assert facts["test/nmse_aligned"] < facts[f"baseline/{name}/nmse_aligned"]
    assert facts["test/nmse_scalar"] is not None and "aligned" in objects.methods[0].made
    predictor = gsparc.load(tmp_path / "model.ckpt")
    assert predictor.known == "up to a phase and a delay of each row"
    with pytest.raises(ValueError, match="to=taps: channels are known up to a phase and a delay"):
        predictor.site.need_phase("to=taps")


def test_none_keeps_rows_as_they_are(logged, tmp_path, caplog):
    words = ("dataset=own", f"dataset.file={logged / 'logged.npz'}", "model=complex_gp", "dataset.align=none")
    with caplog.at_level(logging.WARNING):
        facts, _ = train(campaigns.compose(*words, "baselines=[]", "logger=none"), tmp_path)
    assert facts["test/nmse"] > 0.8 and "of its own" not in caplog.text


def test_fitted_from_arrays_it_answers_up_to_what_is_free(logged):
    with np.load(logged / "logged.npz") as file:
        arrays = dict(file)
    tested = np.random.default_rng(0).uniform(size=len(arrays["csi"])) < 0.2
    place, csi, tones = arrays["rx_position"], arrays["csi"], arrays["frequency_hz"]
    predictor = gsparc.fit(rx=place[~tested], tx=arrays["tx_position"], csi=csi[~tested], frequency_hz=tones)
    told, true = predictor.csi(rx=place[tested])[:, 0], csi[tested]
    told = told * alignment_factors(told[:, None], true[:, None], tones, "phase+delay")
    assert (np.abs(told - true) ** 2).sum() < 0.06 * (np.abs(true) ** 2).sum()
