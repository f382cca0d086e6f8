"""A file of packets with phases of their own, through check, train and the answers of a model."""

import campaigns
import numpy as np
import packets
import pytest

import gsparc
from gsparc.commands.train import train


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """A file of 300 packets."""
    folder = tmp_path_factory.mktemp("packets")
    given, channel = packets.robot()
    tones = given["frequency_hz"] - given["frequency_hz"].mean()
    del given["run"]
    np.savez(
        folder / "logged.npz", **given, csi=packets.logged(channel, tones, 0).astype(np.complex64)
    )
    return folder


@pytest.mark.slow
def test_a_default_run_is_ahead_of_every_plain_method(logged, tmp_path):
    config = campaigns.compose(
        "dataset=own", f"dataset.file={logged / 'logged.npz'}", "model=gsparc", "logger=none"
    )
    facts, objects = train(config, tmp_path)
    assert (
        facts["dataset/kind"] == "aligned csi" and facts["dataset/unknown_factor"] == "phase+delay"
    )
    # At random, seed 0
    assert facts["test/nmse_aligned"] < 0.05 and facts["test/tone_rmse_db"] < 2.6
    for name in ("mean", "nearest", "idw"):
        assert facts["test/nmse_aligned"] < facts[f"baseline/{name}/nmse_aligned"]
    assert facts["test/nmse_scalar"] is not None and "aligned" in objects.methods[0].description
    predictor = gsparc.load(tmp_path / "model.ckpt")
    assert predictor.known == "up to a phase and a delay of each row"
    with pytest.raises(ValueError, match="to=taps: channels are known up to a phase and a delay"):
        predictor.site.need_phase("to=taps")
