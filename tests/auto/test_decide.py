"""Effects are settled from the site, refused where they mean nothing, and probed on training rows only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from boxes import room_of_spectra
from campaigns import compose
from clocks import wound
from known_arrays import array_site, measure, room_vectors
from rooms import directed, shoebox

from gsparc.array.method import ArrayField
from gsparc.array.moving.method import MovingArrayField
from gsparc.auto.combine import held_out_ratio
from gsparc.auto.decide import (
    Decision,
    contest_array,
    decide_array,
    decide_directions,
    decide_phase,
    fifths,
    probe_array,
    probe_phase,
    spacing_in_wavelengths,
)
from gsparc.auto.method import Gsparc
from gsparc.data.campaigns.rfid import load_rfid, planar_array
from gsparc.data.schema import Site
from gsparc.data.splits import Fold
from gsparc.methods.gp import GaussianProcess
from gsparc.methods.method import FitContext, FitReport
from gsparc.methods.registry import build
from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.ops import SphereGrid
from gsparc.simulate.rfid_sim import ensure_rfid_sim
from gsparc.training.splatting import LearnedField


@pytest.fixture(scope="module")
def spectra(tmp_path_factory):
    return load_rfid(ensure_rfid_sim(tmp_path_factory.mktemp("sim"), count=40, seed=0))


@pytest.fixture()
def channels(spectra) -> Site:
    return replace(spectra.site, kind="csi", static_end="tx", grid=None)


def test_array_needs_spectra_of_a_static_receiver(spectra, channels) -> None:
    assert decide_array("auto", spectra.site, None).on
    assert not decide_array("auto", channels, None).on
    assert not decide_array(False, spectra.site, None).on
    without = replace(spectra.site, array=None)
    assert "no array" in decide_array("auto", without, None).reason
    with pytest.raises(ValueError, match=r"effects\.array=true is not possible"):
        decide_array(True, without, None)


def test_phase_needs_channels_of_a_moving_receiver(spectra, channels) -> None:
    assert decide_phase("auto", channels, None).on
    assert not decide_phase("auto", spectra.site, None).on
    moving_tx = replace(channels, static_end="rx")
    assert decide_phase("auto", moving_tx, None, antennas=1).on  # by reciprocity
    with pytest.raises(ValueError, match=r"effects\.phase=true is not possible: .* before 2 antennas"):
        decide_phase(True, moving_tx, None, antennas=2)
    with pytest.raises(ValueError, match="splatted phase"):
        decide_phase("splat", moving_tx, None)
    with pytest.raises(ValueError, match="choose auto, splat, true or false"):
        decide_phase("on", channels, None)  # type: ignore[arg-type]


def test_directions_need_to_have_been_measured(spectra) -> None:
    told, _, _ = directed(10)
    assert decide_directions("auto", True, told).on and decide_directions(True, False, told).on
    assert "no sources" in decide_directions("auto", False, told).reason
    assert "no directions" in decide_directions("auto", True, replace(told, directions=None)).reason
    assert "moving receiver" in decide_directions("auto", True, spectra).reason
    with pytest.raises(ValueError, match=r"effects\.directions=true is not possible: no directions"):
        decide_directions(True, True, replace(told, directions=None))
    with pytest.raises(ValueError, match="choose auto, true or false"):
        decide_directions("splat", True, told)


def test_every_row_is_held_out_once() -> None:
    rows = np.arange(3, 20)
    folds = fifths(rows, 0)
    assert sorted(np.concatenate([fold.test for fold in folds])) == list(rows)
    assert all(not set(fold.test) & set(fold.train) for fold in folds) and len(folds) == 5


def test_an_ablation_of_the_networks_is_not_answered_by_another_model(spectra) -> None:
    decision = decide_array("auto", spectra.site, "emission.hidden=8")
    assert not decision.on and "emission.hidden=8" in decision.reason
    assert decide_array(True, spectra.site, "emission.hidden=8").on


def test_probe_accepts_the_array_that_measured_and_refuses_another(spectra) -> None:
    rows = np.arange(30)
    fold = Fold(rows, rows[:0], np.arange(30, 40))
    assert probe_array(ArrayField(), spectra, fold, seed=0).on
    stretched = replace(spectra, site=replace(spectra.site, array=spectra.site.array * 0.6))
    assert not probe_array(ArrayField(), stretched, fold, seed=0).on
    blanked = spectra.target.copy()
    blanked[30:] = 0  # test rows may hold anything: the probe must not look
    assert (
        probe_array(ArrayField(), replace(spectra, target=blanked), fold, seed=0).reason
        == probe_array(ArrayField(), spectra, fold, seed=0).reason
    )


def test_an_array_that_cannot_foretell_spectra_gives_way_to_their_images(tmp_path, monkeypatch) -> None:
    """Spectra of places wavelengths apart went through the array: 18.0 dB, where a process has 23.8."""
    site = array_site(SphereGrid.hemisphere(15, 60), planar_array())
    apart = np.random.default_rng(0).uniform([0.5, 0.5, 0.5], [5.5, 4.5, 2.0], (40, 3))
    data = measure(site, apart, room_vectors(apart, 1, site.array)[0], sha256="apart")
    fold = Fold(np.arange(36), np.arange(0), np.arange(36, 40))
    trial = ArrayField()
    assert probe_array(trial, data, fold, seed=0).on  # it explains them all the same
    monkeypatch.chdir(tmp_path)
    decision = contest_array(trial, GaussianProcess(), data, fold, seed=0)
    assert not decision.on and "wavelengths apart" in decision.reason
    assert not list(tmp_path.iterdir())  # a trial left array_recovery.csv where the user stood
    near = replace(data, tx=apart / 20)
    assert contest_array(trial, GaussianProcess(), near, fold, seed=0).seconds == 0.0  # not held


def test_a_probe_has_seconds_of_the_runs_clock_and_says_when_they_ended_it():
    """It had ten of the wall whatever the run's were of, and its report was dropped."""
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=1)
    quick = {"searches": 2, "search_rows": 60, "margin": 2.0, "clutter": False, "edges": False}
    for seconds, limited in ((1e-3, "processor"), (1e4, None)):
        probe = ImageSourceGP(**quick, budget_s=seconds)
        assert probe_phase(probe, GaussianProcess(), data, fold, 0, "processor").limited_by == limited
        assert held_out_ratio(probe, data, fold.train, 0, "processor")[2] == limited


def test_deciding_is_billed_by_the_clock_of_the_budget(tmp_path, monkeypatch):
    clocks, given = wound(monkeypatch), []

    def decide(self, data, fold, context):
        clocks.monotonic.wind(1000.0)
        clocks.process_time.wind(2.0)
        return (Decision("phase", False, "slow", 1000.0, "wall"),)

    monkeypatch.setattr(Gsparc, "_decide", decide)
    monkeypatch.setattr(LearnedField, "fit", lambda *a: given.append(a[3].budget_s) or FitReport(3.0))
    _, data, fold = shoebox(20, size=(3.0, 2.5, 2.2), max_order=0)
    context = FitContext(tmp_path, budget_s=10.0, budget_clock="processor")
    report = build(compose().model).fit(data, fold, context)
    assert given == [pytest.approx(8.0, abs=0.01)]
    assert report.seconds == 1003 and report.limited_by == "wall"


def test_spacing_is_in_wavelengths(spectra) -> None:
    rows = np.arange(40)
    doubled = replace(spectra, tx=spectra.tx * 2)
    assert spacing_in_wavelengths(doubled, rows) == pytest.approx(2 * spacing_in_wavelengths(spectra, rows))


def test_a_moving_array_is_answered_by_bearings() -> None:
    data = room_of_spectra()
    assert decide_array("auto", data.site, None).on
    with pytest.raises(ValueError, match="splat then A"):
        decide_array("splat", data.site, None)
    rows, moving = np.arange(len(data)), MovingArrayField()
    fold = Fold(rows[:-8], rows[:0], rows[-8:])
    assert probe_array(moving, data, fold, seed=0).on
    turned = replace(data, rx_rotation=data.rx_rotation.copy())
    turned.rx_rotation[0] = np.diag([-1.0, -1.0, 1.0])
    assert not probe_array(moving, turned, fold, seed=0).on
    noise = np.random.default_rng(0).integers(0, 255, data.target.shape).astype(data.target.dtype)
    assert not probe_array(moving, replace(data, target=noise), fold, seed=0).on
