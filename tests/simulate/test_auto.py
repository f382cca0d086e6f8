"""`effects=auto`: requirements, what each effect contributes, and which are kept."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from gsparc.simulate import auto
from gsparc.simulate.attribution import Deliverable, SurveyProbe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.campaign import Decision
from gsparc.simulate.effects import DIFFRACTION, DIFFUSE, REFRACTION, SPECULAR, Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.spectrum import SpectrumSettings
from gsparc.simulate.survey import TracingEngine

FULL = Effects(depth=2, polarisation=False)
RECORD = [
    (0, 0, 1.0),
    (SPECULAR, 1, 0.5),
    (REFRACTION, 1, 0.6),
    (DIFFRACTION, 1, 0.01),
    (SPECULAR | DIFFUSE, 2, 0.02),
    (SPECULAR, 2, 0.05),
]


class Invented(TracingEngine):
    """An engine whose receivers all hear the same record of paths: (mechanisms, order, power)."""

    name, random, wavelength, transmitter = "invented", False, 0.125, np.zeros(3)

    def __init__(self, record=RECORD):
        self.record = record

    def trace(self, receivers, effects, seed=None):
        rng = np.random.default_rng(0)
        count, each = len(receivers), len(self.record)
        power = np.tile([p for _, _, p in self.record], count)
        direction = np.abs(rng.normal(size=(count * each, 3)))
        whole = TracedPaths(
            np.arange(count + 1) * each,
            np.sqrt(power)[:, None].astype(np.complex64),
            rng.uniform(0, 1e-7, count * each),
            (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32),
            np.tile([m for m, _, _ in self.record], count).astype(np.uint8),
            np.tile([o for _, o, _ in self.record], count).astype(np.uint8),
        )
        return whole.keep_effects(effects)


def heard(count, record=RECORD):
    return Invented(record).trace(np.zeros((count, 3)), FULL)


def probe_of(paths, nearest=None, tones=(2.4e9,)):
    small = SpectrumSettings(height=18, width=36)
    return SurveyProbe(paths, FULL, np.array(tones), 0.125, np.zeros((1, 3)), small, nearest)


def with_odd_receiver(paths):
    """Receiver 0 hears almost only its diffuse path."""
    gain = paths.gain.copy()
    gain[4] *= 1e3
    return replace(paths, gain=gain)


def decided(deliverable, record=RECORD):
    paths = heard(20, record)
    probe = probe_of(paths, paths, np.linspace(2.4e9, 2.48e9, 26))
    settings = AutoSettings(deliverable=deliverable, probes=20, held_back=20, full=FULL)
    choice = auto.choose_effects(probe, settings)
    return auto.verify_choice(choice, settings, probe.errors(choice.effects, settings.required))


@pytest.mark.parametrize(
    "text, kind, tolerance",
    [
        ("coverage +-1 dB", "coverage", 1.0),
        ("coverage ±2.5 dB", "coverage", 2.5),
        ("csi -20 dB", "csi", -20.0),
        ("csi 30 dB", "csi", -30.0),
        ("spectrum skill", "spectrum", 0.1),
        ("spectrum skill 0.8", "spectrum", 0.2),
    ],
)
def test_words_become_a_deliverable(text, kind, tolerance):
    assert Deliverable.parse(text) == Deliverable(kind, pytest.approx(tolerance))


@pytest.mark.parametrize(
    "wrong",
    [
        {"deliverable": "coverge 1 dB"},
        {"deliverable": "spectrum skill 1.5"},
        {"deliverable": "csi -20 dB please"},
        {"rays": 0},
        {"rays": 2},
        {"confidence": 1.0},
        {"probes": 3},
    ],
)
def test_bad_settings_are_refused(wrong):
    refused(next(iter(wrong)), AutoSettings, **wrong)


def test_coverage_drops_what_is_below_a_decibel():
    choice = decided("coverage +-1 dB")
    assert set(choice.effects.enabled) == {"line_of_sight", "specular", "refraction"}
    assert choice.effects.depth == 1
    rows = {row.effect: row for row in choice.table}
    assert rows["refraction"].share == pytest.approx(0.6 / 2.18, rel=1e-4)
    assert rows["refraction"].error == pytest.approx(-10 * np.log10(1 - 0.6 / 2.18), rel=1e-4)
    assert rows["refraction"].kept and not rows["diffuse"].kept and not rows["depth > 1"].kept
    assert choice.verdict is not None and choice.verdict.kept and choice.verdict.met == 1.0


def test_stricter_deliverable_keeps_more():
    loose, strict = decided("csi -10 dB").effects, decided("csi -60 dB").effects
    assert set(loose.enabled) < set(strict.enabled)
    assert strict == replace(FULL, edge_diffraction=False)  # there is none in the record


def test_effects_dropped_together_are_judged_together():
    """Each of two effects alone is within tolerance, both together are not."""
    record = [(0, 0, 1.0), (REFRACTION, 1, 0.15), (DIFFRACTION, 1, 0.15)]
    effects = decided("coverage +-1 dB", record).effects
    assert effects.refraction != effects.diffraction


def test_one_odd_receiver_does_not_keep_everything():
    """A single probe in a corner once kept every effect of a whole room."""
    choice = auto.choose_effects(probe_of(with_odd_receiver(heard(128))), AutoSettings(full=FULL))
    assert not choice.effects.diffuse and choice.effects.specular


@pytest.mark.parametrize(
    "probes, quantile, confidence, most",
    [
        (128, 0.95, 0.85, 3),
        (64, 0.95, 0.85, 0),
        (96, 0.95, 0.9, 1),
        (16, 0.95, 0.9, 0),
    ],
)
def test_few_failures_prove_the_quantile(probes, quantile, confidence, most):
    """Drawn: a violated requirement passes no more often than promised."""
    settings = AutoSettings(quantile=quantile, confidence=confidence)
    assert settings.allowed_failures(probes) == most
    if probes > 60:  # fewer prove nothing, even without a failure
        outside = np.random.default_rng(0).random((20_000, probes)) < 1 - quantile
        assert (outside.sum(1) <= most).mean() < 1 - confidence + 0.01


def test_fewer_rays_are_taken_where_probes_stay_within_tolerance():
    """By powers of another trace: of 3 of 128 outside."""
    choice = replace(decided("coverage +-1 dB"), effects=FULL)

    def tried(outside):
        probe = probe_of(heard(128))
        gain = probe.paths.gain * 1.05
        gain[: outside * len(RECORD)] *= 2
        thinned = replace(probe.paths, gain=gain)
        return auto.choose_rays(choice, AutoSettings(full=FULL), probe, thinned, 300)

    taken = tried(3)
    row = taken.table[-1]
    assert taken.samples == 300 and not row.kept and row.effect == "rays > 300"
    assert row.error == pytest.approx(20 * np.log10(1.05), rel=1e-4)
    for without in (tried(4), auto.keep_all_rays(taken)):
        assert without.samples is None and without.table[-1].kept
    assert Choice.from_dict(dataclasses.asdict(taken)) == taken


def test_violated_requirement_is_reported():
    other = probe_of(heard(30, [(0, 0, 1.0), (DIFFRACTION, 1, 3.0)]))
    choice, settings = decided("coverage +-1 dB"), AutoSettings()
    verdict = auto.verify_choice(
        choice, settings, other.errors(choice.effects, settings.required)
    ).verdict
    assert verdict is not None and not verdict.kept and verdict.met == 0.0


def test_spectra_are_judged_against_the_nearest_receiver():
    choice = decided("spectrum skill 0.9")
    assert choice.effects.line_of_sight and choice.effects.specular
    paths = heard(20)
    same = probe_of(paths, paths.select_paths(paths.order == 0))
    assert (same.errors(paths, Deliverable("spectrum", 0.1)) == 0).all()
    assert (same.errors(paths, Deliverable("csi", -20.0)) == -99).all()
    refused("nearest", probe_of(paths).errors, FULL, Deliverable("spectrum", 0.1))


def test_channel_error_of_a_dropped_path_is_its_share_of_energy():
    paths = TracedPaths(
        np.array([0, 2]),
        np.array([[1.0], [0.1]], np.complex64),
        np.array([0.0, 1e-8]),
        np.array([[0, 0, 1], [0, 0, 1]], np.float32),
        np.array([0, SPECULAR], np.uint8),
        np.array([0, 1], np.uint8),
    )
    probe, h = probe_of(paths), 1 + 0.1 * np.exp(-2j * np.pi * 24)
    assert probe.nmse(FULL.switch_off("specular"))[0] == pytest.approx(0.01 / abs(h) ** 2, rel=1e-4)
    assert probe.lost_power_shares(FULL.switch_off("specular"))[0] == pytest.approx(
        0.01 / 1.01, rel=1e-4
    )
    assert probe.nmse(FULL)[0] == 0.0


def test_decision_survives_its_file():
    decision = Decision(decided("coverage +-1 dB"), FULL, 300)
    assert Decision.from_dict(json.loads(json.dumps(dataclasses.asdict(decision)))) == decision
