"""Taps of known channels, their Doppler, and the file of them."""

import numpy as np
import pytest
from campaigns import compose
from scipy.interpolate import CubicSpline

import gsparc
from gsparc.apps.export.along.taps import Trajectory, fit_taps
from gsparc.commands import export
from gsparc.data.schema import LIGHT, Site
from gsparc.models import checkpoint
from gsparc.prediction.channels import Paths
from gsparc.tables.raw import read_raw

CARRIER = 3.5e9


def site_of(tones: np.ndarray) -> Site:
    """A transmitter that stands still, at these tones [Hz]."""
    return Site("two rays", "csi", "tx", None, None, CARRIER, tones)


class Rays:
    """A line of sight and a mirror image, of an array of three antennas;
    `paths` where it is asked to.
    """

    sources = np.array([[0.0, 0, 5], [0, -40, 5], [-55.0, 0, 5]])

    def __init__(self, tones, with_paths=False):
        self.site, self.with_paths = site_of(tones), with_paths

    def csi(self, tx=None, rx=None):
        return self._paths(rx).channel(self.site.tones())

    def paths(self, rx):
        if not self.with_paths:
            raise ValueError("paths: channels are not made of paths")
        return self._paths(rx)

    def _paths(self, rx):
        array = np.array([[0.0, 0, 0], [0.04, 0, 0], [0.08, 0, 0]])
        middle = float(self.site.tones().mean())
        away = np.linalg.norm(rx[:, None, None] - (self.sources + array[:, None])[None], axis=-1)
        gain = (1e-3 / away * np.exp(-2j * np.pi * middle * away / LIGHT)).astype(np.complex64)
        return Paths(gain, away / LIGHT, middle)


def drive(speed=10.0, length=0.5):
    start = np.array([30.0, 10, 1.5])
    time_s = np.array([0.0, length])
    return Trajectory(time_s, start + np.outer(time_s * speed, [1.0, 0, 0]))


TONES = CARRIER + 240e3 * (np.arange(128) - 63.5)


@pytest.mark.parametrize("with_paths", [False, True])
def test_taps_sum_to_the_channel_at_any_time(with_paths):
    model, way = Rays(TONES, with_paths), drive()
    line = fit_taps(model, way, 48, 38.4e6, 3)
    assert line.residual < 1e-3 and line.worst < 1e-2
    between = np.linspace(0.003, 0.497, 37)  # not instants
    tones = TONES[20:-20]
    delay = (line.first + np.arange(48)) / line.rate_hz
    taps = CubicSpline(line.time_s, line.gain)(between)  # as a reader of the file has it
    summed = taps @ np.exp(-2j * np.pi * np.outer(delay, tones - line.carrier_hz))
    true = model._paths(way.places_at(between)).channel(tones)
    assert np.mean(np.abs(summed - true) ** 2) < 2e-3 * np.mean(np.abs(true) ** 2)


@pytest.mark.parametrize(
    "said, tones, length, rate_hz",
    [
        ("each later than the one before", TONES, 0.0, None),
        ("rate_hz= is needed", TONES[:1], 0.5, None),
        ("the tones span", TONES, 0.5, 1e6),
        ("wavelengths long", TONES, 1e4, None),
    ],
)
def test_what_cannot_be_is_refused(said, tones, length, rate_hz):
    with pytest.raises(ValueError, match=said):
        fit_taps(Rays(tones), drive(length=length), 4, rate_hz)


def test_the_command_writes_taps_and_says_what_they_leave(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    tones = 30e6 + 1e5 * np.arange(8)  # few measurements know waves of ten metres
    rx, ray = rng.uniform([25, 5, 1], [40, 15, 2], (40, 3)), Rays(tones)
    csi = ray.csi(rx=rx)[:, 0]
    model = gsparc.fit(rx=rx, tx=ray.sources[0], csi=csi, frequency_hz=tones, model="complex_gp")
    checkpoint.save(tmp_path / "model.ckpt", model.method)
    (tmp_path / "drive.csv").write_text("time_s,x,y,z\n0,30,10,1.5\n0.02,30.2,10,1.5\n")
    monkeypatch.setattr("gsparc.runs.output.run_directory", lambda: tmp_path)

    def run(*given):
        return export.task(compose(*given, config="export"))

    out, common = (
        tmp_path / "out",
        (f"ckpt={tmp_path}/model.ckpt", "to=taps", f"table={tmp_path}/drive.csv"),
    )
    facts = run(*common, f"out={out}", "taps=4")
    assert facts["taps/residual_db"] < -1
    held = read_raw(out / "taps.npz")
    assert held.arrays["gain"].shape == (4, 1, 4) and held.arrays["delay_s"].shape == (4,)
    (tmp_path / "still.csv").write_text("x,y,z\n30,10,1.5\n31,10,1.5\n")
    with pytest.raises(ValueError, match="no column time_s"):
        run(*common[:2], f"table={tmp_path}/still.csv", f"out={tmp_path}/other")
    assert not (tmp_path / "other").exists()
