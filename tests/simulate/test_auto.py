import dataclasses
import json

import numpy as np
import pytest

from gsparc.simulate import auto
from gsparc.simulate.attribution import Deliverable, Probe, combinations, removals
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.deciding import Decision, Traced, pays
from gsparc.simulate.effects import DIFFRACTION, DIFFUSE, REFRACTION, SPECULAR, PropagationEffects
from gsparc.simulate.paths import Paths
from gsparc.simulate.spectrum import SpectrumSettings
from gsparc.simulate.survey import Survey

FULL = PropagationEffects(depth=2, polarisation=False)


class Invented:
    """An engine whose receivers all hear the same record of paths; power by mechanism is known."""

    name, random, wavelength = "invented", False, 0.125
    transmitter = np.zeros(3)

    def __init__(self, record):
        self.record = record  # list of (mechanisms, order, power)

    def supported(self, effects):
        return effects

    def materials(self):
        return {}

    def versions(self):
        return {}

    def trace(self, receivers, effects, seed=None):
        rng = np.random.default_rng(0)
        count, each = len(receivers), len(self.record)
        power = np.tile([p for _, _, p in self.record], count)
        direction = np.abs(rng.normal(size=(count * each, 3)))
        whole = Paths(
            np.arange(count + 1) * each, np.sqrt(power)[:, None].astype(np.complex64),
            rng.uniform(0, 1e-7, count * each),
            (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32),
            np.tile([m for m, _, _ in self.record], count).astype(np.uint8),
            np.tile([o for _, o, _ in self.record], count).astype(np.uint8),
        )  # fmt: skip
        return whole.under(effects)


RECORD = [(0, 0, 1.0), (SPECULAR, 1, 0.5), (REFRACTION, 1, 0.6), (DIFFRACTION, 1, 0.01),
          (SPECULAR | DIFFUSE, 2, 0.02), (SPECULAR, 2, 0.05)]  # fmt: skip


def decided(deliverable, record=RECORD):
    engine, receivers = Invented(record), np.random.default_rng(0).uniform(size=(20, 3))
    elements, small = np.zeros((1, 3)), SpectrumSettings(height=18, width=36)
    probe = Probe(engine.trace(receivers, FULL), FULL, np.linspace(2.4e9, 2.48e9, 26), 0.125, elements,
                  small, engine.trace(receivers + 1, FULL))  # fmt: skip
    settings = AutoSettings(deliverable=deliverable, probes=20, held_back=20, full=FULL)
    choice = auto.decide(probe, settings, lambda p: {"diffuse": "smooth"})
    return auto.verify(choice, settings, probe.errors(choice.effects, settings.required))


def test_words_become_a_deliverable():
    assert Deliverable.parse("coverage +-1 dB") == Deliverable("coverage", 1.0)
    assert Deliverable.parse("coverage ±2.5 dB").tolerance == 2.5
    assert Deliverable.parse("csi -20 dB") == Deliverable("csi", -20.0)
    assert Deliverable.parse("csi 30 dB").tolerance == -30.0
    assert Deliverable.parse("spectrum skill") == Deliverable("spectrum", 0.1)
    assert Deliverable.parse("spectrum skill 0.8").tolerance == pytest.approx(0.2)
    for wrong in ("coverge 1 dB", "spectrum skill 1.5", "csi -20 dB please"):
        with pytest.raises(ValueError, match=r"effects\.deliverable"):
            Deliverable.parse(wrong)


def test_coverage_drops_what_is_below_a_decibel_and_says_so():
    choice = decided("coverage +-1 dB")
    assert set(choice.effects.on) == {"line_of_sight", "specular", "refraction"}
    assert choice.effects.depth == 1
    rows = {row.effect: row for row in choice.table}
    assert rows["refraction"].share == pytest.approx(0.6 / 2.18, rel=1e-4)
    assert rows["refraction"].error == pytest.approx(-10 * np.log10(1 - 0.6 / 2.18), rel=1e-4)
    assert rows["refraction"].kept and not rows["diffuse"].kept and not rows["depth > 1"].kept
    assert rows["diffuse"].reason == "smooth"
    assert choice.verdict is not None and choice.verdict.kept and choice.verdict.met == 1.0


def test_a_stricter_deliverable_keeps_more():
    loose, strict = decided("csi -10 dB").effects, decided("csi -60 dB").effects
    assert set(loose.on) < set(strict.on)
    assert strict == dataclasses.replace(FULL, edge_diffraction=False)  # there is none in the record


def test_what_is_dropped_together_is_judged_together():
    """Each of two effects alone is within tolerance, both together are not."""
    record = [(0, 0, 1.0), (REFRACTION, 1, 0.15), (DIFFRACTION, 1, 0.15)]
    effects = decided("coverage +-1 dB", record).effects
    assert effects.refraction != effects.diffraction


def test_a_first_look_decides_what_is_clear_and_no_more():
    """Nothing outside on 64 probes is enough; one outside is not, and is neither clearly in."""
    whole = Invented(RECORD).trace(np.zeros((64, 3)), FULL)
    probe = Probe(whole, FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)), SpectrumSettings())
    choice = auto.decide(probe, AutoSettings(full=FULL), lambda p: {}, last=False)
    assert choice is not None and choice.probes == 64
    assert set(choice.effects.on) == {"line_of_sight", "specular", "refraction"}
    odd = whole.gain.copy()
    odd[4] *= 1e3  # receiver 0 hears almost only its diffuse path
    unclear = dataclasses.replace(probe, paths=dataclasses.replace(whole, gain=odd))
    assert auto.decide(unclear, AutoSettings(full=FULL), lambda p: {}, last=False) is None


@pytest.mark.parametrize("probes, quantile, confidence, most", [
    (128, 0.95, 0.85, (0, 3)), (96, 0.95, 0.9, (-1, 1)), (48, 0.95, 0.9, (-1, 0)), (16, 0.95, 0.9, (-1, 0)),
])  # fmt: skip
def test_few_failures_prove_the_quantile(probes, quantile, confidence, most):
    """Drawn: a violated requirement passes one of both looks no more often than promised."""
    first = auto.first_look(probes)
    assert auto.allowed_failures(first, probes, quantile, confidence) == most
    if probes > 60:  # fewer prove nothing, even without a failure
        outside = np.random.default_rng(0).random((20_000, probes)) < 1 - quantile
        passed = (outside[:, :first].sum(1) <= most[0]) | (outside.sum(1) <= most[1])
        assert passed.mean() < 1 - confidence + 0.01


def test_prices_rank_sets():
    full = PropagationEffects(depth=5)
    assert auto.price(full, full) == 1
    assert (
        auto.price(dataclasses.replace(full, depth=3), full) < auto.price(full.without("diffuse"), full) < 1
    )


def test_fewer_rays_are_taken_where_probes_stay_within_tolerance():
    """By powers and channels of another trace: of none of 64 outside, or of 3 of 128."""
    settings, whole = AutoSettings(full=FULL), Invented(RECORD).trace(np.zeros((128, 3)), FULL)
    choice = dataclasses.replace(decided("coverage +-1 dB"), effects=FULL)

    def tried(outside, count, last):
        probe = Probe(whole.take(np.arange(count)), FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)),
                      SpectrumSettings())  # fmt: skip
        gain = probe.paths.gain * 1.05
        gain[: outside * len(RECORD)] *= 2
        return auto.fewer_rays(
            choice, settings, probe, dataclasses.replace(probe.paths, gain=gain), 300, last
        )

    taken = tried(0, 64, last=False)
    assert taken.samples == 300 and not taken.table[-1].kept and taken.table[-1].effect == "rays > 300"
    assert taken.table[-1].error == pytest.approx(20 * np.log10(1.05), rel=1e-4)
    assert taken.table[-1].nmse == pytest.approx(0.05**2, rel=1e-3)
    assert tried(1, 64, last=False) is None and tried(3, 128, last=True).samples == 300
    for refused in (tried(2, 64, last=False), tried(4, 128, last=True)):
        assert refused.samples is None and refused.table[-1].kept
    assert auto.without_fewer_rays(taken).samples is None and auto.without_fewer_rays(taken).table[-1].kept
    assert Choice.from_dict(dataclasses.asdict(taken)) == taken
    assert auto.price(FULL, FULL, 0.3) == pytest.approx(0.44)


@pytest.mark.parametrize("wrong", [{"rays": 0}, {"rays": 2}, {"confidence": 1.0}, {"probes": 3}])
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=r"effects\."):
        AutoSettings(**wrong)


def test_one_odd_receiver_does_not_keep_everything():
    """A single probe in a corner once kept every effect of a whole room."""
    engine, count = Invented(RECORD), 128
    whole = engine.trace(np.zeros((count, 3)), FULL)
    odd = whole.gain.copy()
    odd[4] *= 1e3  # receiver 0 hears almost only its diffuse path
    engine.trace = lambda receivers, effects, seed=None: dataclasses.replace(whole, gain=odd)
    probe = Probe(engine.trace(None, FULL), FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)),
                  SpectrumSettings())  # fmt: skip
    choice = auto.decide(probe, AutoSettings(full=FULL), lambda p: {})
    assert not choice.effects.diffuse and choice.effects.specular


def test_a_violated_requirement_is_reported():
    choice = decided("coverage +-1 dB")
    other = Invented([(0, 0, 1.0), (DIFFRACTION, 1, 3.0)]).trace(np.zeros((30, 3)), FULL)
    probe = Probe(other, FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)), SpectrumSettings())
    errors = probe.errors(choice.effects, AutoSettings().required)
    verdict = auto.verify(choice, AutoSettings(), errors).verdict
    assert verdict is not None and not verdict.kept and verdict.met == 0.0


def test_spectra_are_judged_against_the_nearest_receiver():
    choice = decided("spectrum skill 0.9")
    assert choice.effects.line_of_sight and choice.effects.specular
    again = Invented(RECORD).trace(np.zeros((20, 3)), FULL)
    small, sight = SpectrumSettings(height=18, width=36), again.select(again.order == 0)
    same = Probe(again, FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)), small, sight)
    assert (same.errors(again, Deliverable("spectrum", 0.1)) == 0).all()
    assert (same.errors(again, Deliverable("csi", -20.0)) == -99).all()
    probe = Probe(Invented(RECORD).trace(np.zeros((2, 3)), FULL), FULL, np.array([2.4e9]), 0.125,
                  np.zeros((1, 3)), SpectrumSettings())  # fmt: skip
    with pytest.raises(ValueError, match="nearest"):
        probe.errors(FULL, Deliverable("spectrum", 0.1))


def test_channel_error_of_a_dropped_path_is_its_share_of_energy():
    paths = Paths(np.array([0, 2]), np.array([[1.0], [0.1]], np.complex64), np.array([0.0, 1e-8]),
                  np.array([[0, 0, 1], [0, 0, 1]], np.float32), np.array([0, SPECULAR], np.uint8),
                  np.array([0, 1], np.uint8))  # fmt: skip
    probe = Probe(paths, FULL, np.array([2.4e9]), 0.125, np.zeros((1, 3)), SpectrumSettings())
    h = 1 + 0.1 * np.exp(-2j * np.pi * 24)
    assert probe.nmse(FULL.without("specular"))[0] == pytest.approx(0.01 / abs(h) ** 2, rel=1e-4)
    assert probe.shares(FULL.without("specular"))[0] == pytest.approx(0.01 / 1.01, rel=1e-4)
    assert probe.nmse(FULL)[0] == 0.0


def test_removals_and_combinations_are_complete():
    found = removals(PropagationEffects(depth=3))
    assert set(found) == {"line_of_sight", "specular", "refraction", "diffraction", "edge_diffraction",
                          "diffuse", "depth > 2", "depth > 1", "polarisation"}  # fmt: skip
    assert found["depth > 1"].depth == 1
    sets = combinations(PropagationEffects(depth=3), ("diffuse", "depth > 2", "polarisation"))
    assert len(sets) == 8 and sets[0] == PropagationEffects(depth=3)


def test_a_choice_survives_its_file():
    choice = decided("coverage +-1 dB")
    assert Choice.from_dict(dataclasses.asdict(choice)) == choice
    noted = json.loads(json.dumps(Decision(choice, FULL, 300).note()))
    assert Decision.of(noted) == Decision(choice, FULL, 300)


def test_fewer_effects_are_compiled_for_only_where_that_pays():
    """A decision taken over compiled the solver anew for rows whose time was less than that of compiling."""
    unseen = dataclasses.replace(decided("coverage +-1 dB"), row_all=0.02, compiling=2.0)
    assert not pays(unseen, 200, 0.2) and pays(unseen, 900, 0.2)
    assert not pays(dataclasses.replace(unseen, reused=True), 900, 0.2)  # two sizes of calls
    assert pays(dataclasses.replace(unseen, row_chosen=0.018), 200, 0.2)  # its kernels are there
    assert pays(dataclasses.replace(unseen, compiling=None), 200, 0.2)


def test_nothing_is_saved_where_everything_is_needed():
    """Of florence a run said "-15% saved"."""
    choice = dataclasses.replace(decided("coverage +-1 dB"), row_all=0.02, row_chosen=0.01)
    assert choice.saved == pytest.approx(0.5)
    needed = tuple(dataclasses.replace(row, kept=True) for row in choice.table)
    assert dataclasses.replace(choice, table=needed).saved is None


def test_calls_are_filled_up_with_rows_that_come_next():
    """A call of 50 probes was filled up with places to throw away: a third of a small run's tracing."""
    survey = Survey([Invented(RECORD)], np.zeros((40, 3)))
    traced = Traced(survey, FULL, np.arange(30), 8)
    assert len(traced.paths(np.arange(5))) == 5 and traced.rows.tolist() == list(range(8))
    assert len(traced.paths(np.arange(10))) == 10 and sorted(traced.rows) == list(range(16))
    assert len(traced.paths(np.arange(30))) == 30 and sorted(traced.rows) == list(range(30))
