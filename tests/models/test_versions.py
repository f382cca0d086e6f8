"""Checkpoints of version 1 stay readable: files written when it began answer as they did.

`python tests/models/test_versions.py` writes those that are missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import gsparc
from gsparc.models import checkpoint

FOLDER = Path(__file__).parent / "version1"
RNG = np.random.default_rng(0)
PLACES = np.c_[RNG.uniform(0, 2, (40, 2)), np.full(40, 1.2)]
END, ENDS = np.array([1.0, 3.0, 2.5]), np.array([[0.0, -1, 2.5], [2.0, 3.0, 2.5]])
FAR = np.linalg.norm(PLACES - END, axis=1)
FARS = np.linalg.norm(PLACES[:, None] - ENDS, axis=2)
CHANNELS = {"csi": np.exp(-2j * np.pi * FAR / 0.3) / FAR, "frequency_hz": np.array([1e9])}
IMAGES = np.round(127 + 100 * np.sin(PLACES @ RNG.normal(size=(3, 128)))).astype(np.uint8).reshape(40, 8, 16)
KINDS = {
    "gp-powers": {"model": "gp", "tx": END, "rssi": -30 - 25 * np.log10(FAR)},
    "gsparc-powers": {"tx": END, "rssi": -30 - 25 * np.log10(FAR)},
    "gsparc-stations": {"station_position": ENDS, "rssi": -30 - 25 * np.log10(FARS)},
    "complex_gp-channels": {"model": "complex_gp", "tx": END, **CHANNELS},
    "gsparc-channels": {"tx": END, **CHANNELS},
    "image_source_gp-channels": {
        "model": "image_source_gp",
        "tx": END,
        "settings": {"searches": 1},
        **CHANNELS,
    },
    "gsparc-spectra": {"tx": END, "spectrum": IMAGES},
    "kriging-powers": {"model": "kriging", "tx": END, "rssi": -30 - 25 * np.log10(FAR)},
}


def answers(predictor: gsparc.Predictor) -> torch.Tensor:
    """At some places, of every station; powers as such."""
    site = predictor.site
    asked = [predictor] if site.stations is None else [predictor.at(name) for name in site.stations.name]
    return torch.cat([one.linear(rx=PLACES[:4] + 0.05).mean for one in asked])


def test_there_is_a_file_of_every_kind():
    assert {file.stem for file in FOLDER.glob("*.ckpt")} == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_of_version_1_answers_as_it_did(kind):
    file = FOLDER / f"{kind}.ckpt"
    before = checkpoint.read(file).extra["answers"]
    torch.testing.assert_close(
        answers(gsparc.load(file)), before, rtol=1e-4, atol=1e-5 * float(before.abs().max())
    )


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, given in KINDS.items():
        path = FOLDER / f"{name}.ckpt"
        if not path.exists():
            found = gsparc.fit(rx=PLACES, budget_s=3.0, save=path, **given)
            checkpoint.amend(path, {"answers": answers(found)})
