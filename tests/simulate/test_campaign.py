"""Whole campaigns on our own engine: no ray tracer needed."""

import json
import os
import shutil
import signal
import sys
import time
import tracemalloc
from dataclasses import dataclass, replace
from pathlib import Path

import cloudpickle
import h5py
import numpy as np
import pytest

from gsparc.commands.check import main as check
from gsparc.data import blocks
from gsparc.data.datasets.sionna import _heard
from gsparc.data.errors import DataError
from gsparc.data.load import load
from gsparc.data.own import load_own
from gsparc.data.schema import LIGHT
from gsparc.evaluation.simulated import effect_shares, floor_plan
from gsparc.simulate import campaign as campaigns
from gsparc.simulate import deciding
from gsparc.simulate.assembly import SECONDS, assemble, shard_arrays
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.campaign import simulate
from gsparc.simulate.effects import Effects
from gsparc.simulate.report import choice_table, figures, verdict
from gsparc.simulate.scenes.build import SceneSettings, build
from gsparc.simulate.settings import Campaign, CsiSettings
from gsparc.simulate.shards import ROWS, Shards
from gsparc.simulate.shoebox import Room, ShoeboxEngine, trace
from gsparc.simulate.spectrum import SpectrumSettings

SCENE = SceneSettings(
    name="box", transmitter_m=(1.0, 1.5, 2.6), area_m=((0.2, 0.2), (5.8, 4.8)), height_m=(1.1, 1.5),
    num_receivers=60, carrier_hz=2.4e9, bandwidth_hz=40e6, subcarriers=4,
    room={"size_m": [6, 5, 3], "reflection": -0.6, "boxes_m": [[[2.6, 2.2, 0], [3.0, 2.6, 3]]]},
)  # fmt: skip
MIRROR = Effects(
    refraction=False, diffraction=False, edge_diffraction=False, diffuse=False, polarisation=False
)
SMALL = SpectrumSettings(height=18, width=36, rows=4, columns=4)


def plan(**changes):
    return Campaign(**{"scene": SCENE, "effects": MIRROR, "spectrum": SMALL, "shard": 16, **changes})


def arrays(path):
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}, dict(file.attrs)


def test_the_file_is_the_schema_and_equals_the_exact_room(tmp_path):
    outcome = simulate(plan(), tmp_path / "box.h5")
    stored, about = arrays(tmp_path / "box.h5")
    room = Room(np.zeros(3), np.array([6.0, 5, 3]), np.full(6, -0.6), np.array(SCENE.room["boxes_m"]))
    exact = trace(room, SCENE.transmitter_m, stored["rx_position"], SCENE.frequency_hz, max_order=3).csi
    # the amplitude of a path is the carrier's on all tones: 20 of 2,400 MHz
    np.testing.assert_allclose(stored["csi"], exact, rtol=0.02, atol=1e-4 * np.abs(exact).max())
    assert room.contains(stored["rx_position"]).all()
    assert not (tmp_path / "box.h5.parts").exists()
    assert about["simulator"] == b"gsparc-shoebox" and about["spectrum_rows"] == 4
    assert json.loads(about["effects_json"])["depth"] == 3
    assert load_own(tmp_path / "box.h5").site.kind == "spectrum"
    assert check([str(tmp_path / "box.h5")]) == 0
    assert outcome.convergence is None and outcome.made.facts["paths_per_receiver"] > 5
    assert 0 < about["simulate_s"] <= sum(outcome.seconds.values())
    paths = stored["path_offsets"]
    assert len(paths) == 61 and paths[-1] == len(stored["path_delay"]) == len(stored["path_direction"])


def test_paths_make_the_channel(tmp_path):
    """Gain and delay are as the attributes state."""
    simulate(plan(weakest_db=200.0), tmp_path / "box.h5")
    stored, _ = arrays(tmp_path / "box.h5")
    some = slice(*stored["path_offsets"][7:9])
    tones = np.exp(-2j * np.pi * np.outer(stored["path_delay"][some], stored["frequency_hz"]))
    np.testing.assert_allclose(stored["path_gain"][some] @ tones, stored["csi"][7, 0], rtol=1e-4)


def test_it_is_read_as_spectra_and_as_channels(tmp_path):
    simulate(plan(csi=CsiSettings(rows=2, columns=2)), tmp_path / "box.h5")
    spectra, csi = (
        load({"name": "sionna", "file": str(tmp_path / "box.h5"), "target": target})
        for target in ("spectrum", "csi")
    )
    assert spectra.site.kind == "spectrum" and spectra.target.shape == (60, 18, 36)
    assert spectra.site.static_end == csi.site.static_end == "tx"
    assert spectra.site.array.shape == (16, 3) and csi.site.array.shape == (4, 3)
    assert csi.site.kind == "csi" and csi.target.shape == (60, 4, 4)
    assert spectra.site.sha256 != csi.site.sha256
    assert len(spectra.release_split[1]) == 18
    assert load({"name": "sionna", "file": str(tmp_path / "box.h5")}).site.kind == "spectrum"
    with pytest.raises(DataError, match=r"dataset\.target=power.* holds spectrum and csi and rssi"):
        load({"name": "sionna", "file": str(tmp_path / "box.h5"), "target": "power"})


def test_it_is_read_as_powers(tmp_path):
    """Sums of path powers; where no path arrives, a power is below the weakest that was heard."""
    blocked = replace(SCENE, room={**SCENE.room, "boxes_m": [[[2.6, 0, 0], [3.0, 4.0, 3]]]})
    direct = Effects(**{**vars(MIRROR), "specular": False, "depth": 0})
    made = simulate(plan(scene=blocked, effects=direct), tmp_path / "box.h5").made
    data = load({"name": "sionna", "file": str(tmp_path / "box.h5"), "target": "rssi"})
    heard = made.power > 0
    assert data.site.kind == "rssi" and 0 < heard.sum() < 60 and data.site.convergence_error is None
    np.testing.assert_array_equal(data.censored, ~heard)
    powers = data.target[:, 0] * data.site.target_scale
    np.testing.assert_allclose(powers[heard], made.power[heard], rtol=1e-4)
    np.testing.assert_allclose(powers[~heard], made.power[heard].min(), rtol=1e-4)


def test_one_outlier_does_not_say_how_weak_places_without_a_path_are():
    """In a town one path was 66 dB below the next: 43 places without any counted as weaker still."""
    rng = np.random.default_rng(0)
    power = 10 ** (rng.uniform(-140, -80, 400) / 10)
    weakest = np.sort(power)[1]
    power[power.argmin()] = 10**-21.0
    power[power.argsort()[-2:]] = 0
    found = _heard(power)
    np.testing.assert_allclose(found["sensitivity_db"], 10 * np.log10(weakest))
    assert np.isnan(found["rssi_db"]).sum() == 3
    assert "sensitivity_db" not in _heard(power[power > 0])  # nothing missing: every power is one


def test_noise_is_as_loud_as_said(tmp_path):
    simulate(plan(), tmp_path / "clean.h5")
    simulate(plan(effects=Effects(**{**vars(MIRROR), "noise_snr_db": 20.0})), tmp_path / "noisy.h5")
    clean, noisy = (arrays(tmp_path / f"{name}.h5")[0]["csi"] for name in ("clean", "noisy"))
    ratio = 10 * np.log10(np.mean(np.abs(clean) ** 2) / np.mean(np.abs(noisy - clean) ** 2))
    assert ratio == pytest.approx(20, abs=1.5)
    read = load({"name": "sionna", "file": str(tmp_path / "noisy.h5"), "target": "csi"})
    measured = np.mean(np.abs(noisy - clean) ** 2) / read.site.target_scale**2
    assert read.noise_variance[0] == pytest.approx(measured, rel=0.3)


def test_killed_half_way_and_resumed(tmp_path, monkeypatch):
    """Finished shards are not touched, every receiver is there once, the file is the uninterrupted one's."""
    simulate(plan(), tmp_path / "whole.h5")
    real, calls = ShoeboxEngine.trace, []

    def dies(self, receivers, *rest, **named):
        calls.append(len(receivers))
        if len(calls) == 3:
            raise KeyboardInterrupt
        time.sleep(0.1)
        return real(self, receivers, *rest, **named)

    monkeypatch.setattr(ShoeboxEngine, "trace", dies)
    with pytest.raises(KeyboardInterrupt):
        simulate(plan(), tmp_path / "cut.h5")
    assert not (tmp_path / "cut.h5").exists()
    shards = sorted((tmp_path / "cut.h5.parts").glob("shard_*.npz"))
    before = [(s.name, s.stat().st_mtime_ns, s.read_bytes()) for s in shards]
    assert len(shards) == 2
    seen = []

    def watches(self, receivers, *rest, **named):
        seen.append([(s.name, s.stat().st_mtime_ns, s.read_bytes()) for s in shards])
        return real(self, receivers, *rest, **named)

    monkeypatch.setattr(ShoeboxEngine, "trace", watches)
    simulate(plan(), tmp_path / "cut.h5")
    assert len(seen) == 2 and all(state == before for state in seen)
    (one, about), (two, other) = (arrays(tmp_path / f"{n}.h5") for n in ("whole", "cut"))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    for varying in (about, other):
        del varying["content_sha256"]  # of simulate_s, too
    _, bill = about.pop("simulate_s"), other.pop("simulate_s")
    assert bill > 0.2  # what the killed run had spent on its two shards is in it
    assert about == other and len(np.unique(two["rx_position"], axis=0)) == 60


MASTS = [{"name": "a", "position_m": [1.0, 1.5, 2.6]}, {"name": "b", "position_m": [5.0, 4.0, 2.5]}]


def test_several_transmitters_are_stations_and_every_pair_is_there_once(tmp_path, monkeypatch):
    """Killed and gone on with; a place is tested on with all transmitters or with none."""
    several = replace(SCENE, transmitter_m=None, transmitters=MASTS)
    asked = AutoSettings(probes=16, held_back=20, full=Effects(depth=3))
    real, left = ShoeboxEngine.trace, [5]

    def dies(self, receivers, *rest, **named):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return real(self, receivers, *rest, **named)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ShoeboxEngine, "trace", dies)
        simulate(plan(scene=several, effects=asked), tmp_path / "two.h5")
    assert (tmp_path / "two.h5.parts").exists()
    outcome = simulate(plan(scene=several, effects=asked), tmp_path / "two.h5")
    stored, _ = arrays(tmp_path / "two.h5")
    pairs = np.column_stack([stored["station"], stored["rx_position"]])
    assert len(np.unique(pairs, axis=0)) == len(pairs) == 120 and "tx_position" not in stored
    alone = simulate(plan(effects=outcome.effects), tmp_path / "one.h5")
    of_a, _ = arrays(tmp_path / "one.h5")
    np.testing.assert_array_equal(stored["csi"][:60], of_a["csi"])
    assert alone.survey.places.tolist() == outcome.survey.places.tolist()
    read = load({"name": "sionna", "file": str(tmp_path / "two.h5"), "target": "csi"})
    assert read.site.stations.name == ("a", "b") and read.site.static_end == "tx"
    learn, test = (set(read.place[rows]) for rows in read.release_split)
    assert not learn & test
    floor_plan(outcome, tmp_path / "plan.png")


def test_a_walk_keeps_its_times(tmp_path):
    walk = {"kind": "trajectory", "points_m": [[0.5, 0.5], [5.5, 0.5]], "speed_m_s": 1.0, "every_s": 0.2}
    simulate(plan(scene=replace(SCENE, receivers=walk)), tmp_path / "walk.h5")
    stored, _ = arrays(tmp_path / "walk.h5")
    np.testing.assert_allclose(stored["time_s"], np.arange(26) * 0.2)


def test_parts_of_another_simulation_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(campaigns, "_trace_all", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        simulate(plan(), tmp_path / "box.h5")
    with pytest.raises(ValueError, match="different simulation"):
        simulate(plan(shard=20), tmp_path / "box.h5")


def test_parts_of_another_table_of_places_are_refused(tmp_path, monkeypatch):
    """Shards were kept by the number of a row whose place had changed."""
    table = tmp_path / "places.csv"
    asked = plan(scene=replace(SCENE, receivers={"kind": "file", "file": str(table)}))
    table.write_text("x,y,z\n1,1,1.2\n2,1,1.2\n3,1,1.2\n")
    monkeypatch.setattr(campaigns, "_trace_all", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        simulate(asked, tmp_path / "box.h5")
    table.write_text("x,y,z\n1,1,1.2\n2,1,1.2\n3,4,1.2\n")
    with pytest.raises(ValueError, match="different simulation"):
        simulate(asked, tmp_path / "box.h5")


def test_a_kill_amid_the_removal_leaves_no_shards_without_their_plan(tmp_path, monkeypatch):
    """Shards whose plan was removed first would pass for those of any other simulation."""

    def dies(folder):
        next(Path(folder).glob("*plan.json")).unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", dies)
        with pytest.raises(KeyboardInterrupt):
            simulate(plan(), tmp_path / "box.h5")
    (tmp_path / "box.h5").unlink()
    simulate(plan(csi=CsiSettings(rows=2, columns=2)), tmp_path / "box.h5")
    assert arrays(tmp_path / "box.h5")[0]["csi"].shape[1:] == (4, 4)
    assert {path.name for path in tmp_path.iterdir()} == {"box.h5"}


def test_an_existing_file_is_not_overwritten(tmp_path):
    (tmp_path / "box.h5").write_text("mine")
    with pytest.raises(ValueError, match="exists"):
        simulate(plan(), tmp_path / "box.h5")
    assert (tmp_path / "box.h5").read_text() == "mine"


def test_auto_decides_once_verifies_and_is_drawn(tmp_path):
    asked = AutoSettings(probes=16, held_back=20, full=Effects(depth=4))
    outcome = simulate(plan(effects=asked), tmp_path / "box.h5")
    choice = outcome.choice
    assert choice is not None and choice.verdict is not None and choice.verdict.kept
    assert set(outcome.effects.on) == {"line_of_sight", "specular"} and 1 <= outcome.effects.depth < 4
    stored = json.loads(arrays(tmp_path / "box.h5")[1]["auto"])
    assert [row["effect"] for row in stored["table"]] == [row.effect for row in choice.table]
    facts = figures(outcome)
    assert facts["auto/verdict/met"] >= 0.95 and facts["auto/specular/kept"] is True
    assert "requirement met" in verdict(choice) and choice_table(choice).row_count == len(choice.table)
    for draw, what in ((floor_plan, outcome), (effect_shares, choice)):
        draw(what, tmp_path / "picture.png")
        assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_probes_are_rows_of_the_file_and_a_decision_is_kept(tmp_path, monkeypatch):
    """No row is traced twice, and the next set of receivers of the same scene asks no probes."""
    real, traced = ShoeboxEngine.trace, []

    def counts(self, receivers, effects, seed=None):
        traced.append((len(receivers), effects.depth))
        return real(self, receivers, effects, seed)

    monkeypatch.setattr(ShoeboxEngine, "trace", counts)
    asked = AutoSettings(probes=16, held_back=20, full=Effects(depth=4))
    first = simulate(plan(effects=asked), tmp_path / "first.h5")
    assert sum(count for count, _ in traced) == 60 and first.effects.depth < 4
    chosen, _ = arrays(tmp_path / "first.h5")
    simulate(plan(effects=first.effects), tmp_path / "same.h5")
    same, _ = arrays(tmp_path / "same.h5")
    for name in chosen:  # what probes kept of their full trace is what a run with the choice finds
        np.testing.assert_array_equal(chosen[name], same[name], err_msg=name)
    traced.clear()
    again = simulate(plan(effects=asked, scene=replace(SCENE, seed=3)), tmp_path / "again.h5")
    assert again.choice.reused and again.effects == first.effects
    assert sum(count for count, _ in traced) == 60 and {depth for _, depth in traced} == {first.effects.depth}
    moved = replace(SCENE, transmitter_m=(1.0, 1.4, 2.6))
    assert not simulate(plan(effects=asked, scene=moved), tmp_path / "moved.h5").choice.reused
    fresh = replace(asked, reuse=False)
    assert not simulate(plan(effects=fresh), tmp_path / "fresh.h5").choice.reused


class Rays(ShoeboxEngine):
    """Our own engine as if it had rays: fewer than all miss by `off`."""

    random, samples, off = True, None, 1.05

    def thinned(self, samples):
        other = Rays(self.room, self.transmitter, LIGHT / self.wavelength)
        other.samples = samples
        return other

    def trace(self, receivers, effects, seed=None):
        paths = super().trace(receivers, effects, seed)
        miss = 1.0 if self.samples is None else Rays.off
        return replace(paths, gain=paths.gain * np.float32(miss if seed is None else miss * 1.01))


def with_rays(monkeypatch, off: float) -> AutoSettings:
    monkeypatch.setattr("gsparc.simulate.scenes.build.ShoeboxEngine", Rays)
    monkeypatch.setattr(Rays, "off", off)
    monkeypatch.setattr(deciding.Decider, "_may_pay", lambda *unused: True)
    monkeypatch.setattr(deciding, "pays", lambda *unused: True)
    return AutoSettings(probes=64, held_back=64, full=MIRROR)


def test_fewer_rays_are_simulated_where_held_back_receivers_allow_it(tmp_path, monkeypatch):
    """The file says with how many; what was decided on has all of them, and is not in the solver's error."""
    asked, many = with_rays(monkeypatch, 1.05), replace(SCENE, num_receivers=200)
    whole = simulate(plan(scene=many, effects=replace(asked, rays=1.0)), tmp_path / "whole.h5")
    outcome = simulate(plan(scene=many, effects=asked), tmp_path / "fewer.h5")
    assert whole.choice.samples is None and outcome.choice.samples == 90_000
    assert outcome.choice.verdict.kept and outcome.choice.verdict.error == pytest.approx(0.42, abs=0.01)
    (all_, _), (fewer, about) = (arrays(tmp_path / f"{name}.h5") for name in ("whole", "fewer"))
    assert json.loads(about["sampling"])["samples"] == json.loads(about["auto"])["samples"] == 90_000
    ratio = fewer["received_power"] / all_["received_power"]
    decided_on = np.isclose(ratio, 1.0, rtol=1e-5)
    assert 128 <= decided_on.sum() < 200
    np.testing.assert_allclose(ratio[~decided_on], 1.05**2, rtol=1e-4)
    assert outcome.convergence.nmse == pytest.approx(1e-4, rel=0.01)
    assert outcome.convergence.power_db == pytest.approx(20 * np.log10(1.01), rel=0.01)
    assert "90,000 rays" in verdict(outcome.choice) and figures(outcome)["auto/samples"] == 90_000
    again = simulate(plan(scene=replace(many, seed=3), effects=asked), tmp_path / "again.h5")
    assert (
        again.choice.reused and json.loads(arrays(tmp_path / "again.h5")[1]["sampling"])["samples"] == 90_000
    )


def test_fewer_rays_are_refused_where_they_miss(tmp_path, monkeypatch):
    outcome = simulate(plan(effects=with_rays(monkeypatch, 1.2)), tmp_path / "box.h5")
    row = outcome.choice.table[-1]
    assert outcome.choice.samples is None and row.effect == "rays > 90000" and row.kept and row.failures > 0
    assert json.loads(arrays(tmp_path / "box.h5")[1]["sampling"])["samples"] == 300_000


def test_a_decision_that_left_rays_untried_is_taken_anew_where_trying_pays(tmp_path, monkeypatch):
    asked = with_rays(monkeypatch, 1.05)
    with monkeypatch.context() as patch:
        patch.setattr(deciding.Decider, "_may_pay", lambda *unused: False)
        assert simulate(plan(effects=asked), tmp_path / "few.h5").choice.untried
        assert simulate(plan(effects=asked), tmp_path / "same.h5").choice.reused
    many = simulate(plan(effects=asked, scene=replace(SCENE, num_receivers=200)), tmp_path / "many.h5")
    assert not many.choice.reused and many.choice.samples == 90_000


def test_what_held_back_receivers_refute_is_not_simulated(tmp_path, monkeypatch):
    """A run said NOT MET, simulated the choice all the same, and the next set of receivers took it over."""
    real, full = deciding.auto.verify, Effects(**{**vars(MIRROR), "depth": 4})

    def refuted(*arguments):
        choice = real(*arguments)
        return replace(choice, verdict=replace(choice.verdict, kept=False, met=0.9))

    monkeypatch.setattr(deciding.auto, "verify", refuted)
    asked = AutoSettings(probes=16, held_back=20, full=full)
    outcome = simulate(plan(effects=asked), tmp_path / "box.h5")
    assert outcome.effects == outcome.choice.effects == full and outcome.choice.saved is None
    assert "NOT MET by less (line of sight, specular, depth" in verdict(outcome.choice)
    again = simulate(plan(effects=asked, scene=replace(SCENE, seed=3)), tmp_path / "again.h5")
    assert again.choice.reused and again.effects == full


def test_where_few_are_left_everything_is_kept(tmp_path):
    asked = AutoSettings(probes=60, held_back=60, full=Effects(depth=4))
    outcome = simulate(plan(effects=asked), tmp_path / "box.h5")
    assert outcome.effects.depth == 4 and outcome.choice.effects.depth < 4


def test_a_decision_taken_over_simulates_everything_where_few_rows_are_asked(tmp_path, monkeypatch):
    asked = AutoSettings(probes=16, held_back=20, full=Effects(depth=4))
    simulate(plan(effects=asked, shard=60), tmp_path / "first.h5")
    monkeypatch.setattr(deciding, "pays", lambda choice, rows, saved: rows > 60)
    few = simulate(plan(effects=asked), tmp_path / "few.h5")
    assert few.choice.reused and few.effects.depth == 4 and few.choice.effects.depth < 4
    many = simulate(plan(effects=asked, scene=replace(SCENE, num_receivers=61)), tmp_path / "many.h5")
    assert many.choice.reused and many.effects == many.choice.effects


def test_a_kill_between_first_shard_and_decision_mixes_no_effects(tmp_path, monkeypatch):
    """The shard of a decision nobody had noted stayed, beside rows of the decision taken instead of it."""
    asked = AutoSettings(probes=60, held_back=60, full=Effects(depth=4))

    def dies(*unused):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Shards, "write_note", dies)
        simulate(plan(effects=asked), tmp_path / "cut.h5")
    assert (tmp_path / "cut.h5.parts" / "shard_0000.npz").exists()  # everything, at depth 4
    outcome = simulate(plan(effects=asked), tmp_path / "cut.h5")
    assert outcome.choice.reused and outcome.effects.depth < 4
    simulate(plan(effects=outcome.effects), tmp_path / "whole.h5")
    (one, _), (two, _) = (arrays(tmp_path / f"{name}.h5") for name in ("whole", "cut"))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def put_together(out: Path, receivers: int) -> int:
    """Write a file from shards whose rows are those of 20 traced places, again and again; peak memory [B]."""
    asked = plan(
        scene=replace(SCENE, num_receivers=receivers), effects=replace(MIRROR, noise_snr_db=20.0),
        spectrum=replace(SMALL, height=45, width=90, normalisation="none"),
        csi=CsiSettings(rows=4, columns=4), weakest_db=6.0,
    )  # fmt: skip
    survey, shards = build(asked.scene, asked.sampling), Shards(out, {"receivers": receivers})
    wavelength = survey.engine.wavelength
    made = shard_arrays(survey.trace(np.arange(20), MIRROR), asked, wavelength)
    turned = np.random.default_rng(0).permutation(receivers).reshape(-1, 20)
    for number, rows in enumerate(turned, 1):
        shards.put(number, {**made, ROWS: rows, SECONDS: np.array(0.0)})
    tracemalloc.start()
    try:
        assemble(asked, survey, asked.effects, None, None, 0.0, shards)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_spectra_and_channels(tmp_path, monkeypatch):
    """They were all held at once: at 100,000 receivers tens of gigabytes."""
    monkeypatch.setattr(blocks, "BIG", 2**16)
    monkeypatch.setattr(blocks, "BLOCK", 2**16)
    few, many = (put_together(tmp_path / f"{n}.h5", n) for n in (200, 2000))
    stored, _ = arrays(tmp_path / "2000.h5")
    row = stored["spectrum"][0].nbytes + stored["csi"][0].nbytes
    assert row > 4000 and many - few < 0.25 * 1800 * row
    np.testing.assert_array_equal(np.diff(stored["path_offsets"]).reshape(-1, 20).shape, (100, 20))


def test_what_is_put_together_on_disk_is_the_same(tmp_path, monkeypatch):
    noisy = plan(effects=replace(MIRROR, noise_snr_db=20.0))
    simulate(noisy, tmp_path / "memory.h5")
    monkeypatch.setattr(blocks, "BIG", 1024)
    simulate(noisy, tmp_path / "disk.h5")
    (one, _), (two, _) = (arrays(tmp_path / f"{name}.h5") for name in ("memory", "disk"))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


@pytest.mark.parametrize("changes, words", [
    ({"builder": "x"}, "exactly one of"),
    ({"num_receivers": 3}, "at least 20"),
    ({"area_m": ((2.65, 2.25), (2.95, 2.55))}, "0 of 60 receivers"),
    ({"transmitter_m": (9.0, 1.0, 1.0)}, "outside the room"),
    ({"transmitter_m": (9.0, 1.0)}, "three finite numbers"),
    ({"transmitters": [{"position_m": [1, 1, 1]}]}, "not both"),
    ({"transmitter_m": None, "transmitters": []}, "empty list"),
    ({"transmitter_m": None, "transmitters": [{"position_m": [1, 1, 1], "sectors": 3}]}, "isotropic"),
    ({"over": "sea"}, "expected one of zero"),
    ({"receivers": {"knd": "grid"}}, "no such setting"),
])  # fmt: skip
def test_scenes_that_cannot_be_are_refused(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words) as raised:
        simulate(plan(scene=SceneSettings(**{**vars(SCENE), **changes})), tmp_path / "box.h5")
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


@dataclass
class Counted(campaigns._Tracing):
    """Writes beside the file which shards are traced; the process of the third ends, once."""

    def __call__(self, shard):
        begun, killed = (self.shards.out.with_name(name) for name in ("begun", "killed"))
        if not self.shards.path(shard[0]).exists():
            with begun.open("a") as file:
                file.write(f"{shard[0]}\n")
        if shard[0] == 3 and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(shard)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["joblib", "ray"])
def test_workers_share_shards_and_one_is_killed(tmp_path, monkeypatch, engine, elsewhere):
    simulate(plan(shard=8), tmp_path / "whole.h5")
    monkeypatch.setattr(campaigns, "_Tracing", Counted)
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    elsewhere(engine)
    simulate(plan(shard=8), tmp_path / "shared.h5")
    begun = (tmp_path / "begun").read_text().split()
    assert (tmp_path / "killed").exists() and set(begun) == set("12345678") and len(begun) <= 10
    (one, _), (two, _) = arrays(tmp_path / "whole.h5"), arrays(tmp_path / "shared.h5")
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
