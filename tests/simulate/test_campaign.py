"""Whole campaigns on our own engine: no ray tracer needed."""

import json
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
from crashes import small_campaign
from refusals import refused

from gsparc.base.errors import DataError
from gsparc.commands.check import main as check
from gsparc.data import blocks
from gsparc.data.schema import LIGHT
from gsparc.datasets.load import load
from gsparc.pictures.simulated import draw_power_and_delay_spread
from gsparc.simulate import campaign as campaigns
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.campaign import simulate
from gsparc.simulate.effects import Effects
from gsparc.simulate.report import choice_table, describe_choice, summary_facts
from gsparc.simulate.scenes.settings import SceneSettings
from gsparc.simulate.shoebox import Room, ShoeboxEngine, trace_room
from gsparc.simulate.spectrum import ArraySettings
from gsparc.tables.own import load_own

BOX = small_campaign(60)
SCENE, MIRROR, SMALL = BOX.scene, BOX.effects, BOX.spectrum
FEW_PROBES = AutoSettings(probes=16, held_back=20, full=Effects(depth=4))


def plan(**changes):
    return replace(BOX, **{"shard": 16, **changes})


def arrays(path):
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}, dict(file.attrs)


def read(path, target=None):
    return load(
        {"name": "sionna", "file": str(path), **({} if target is None else {"target": target})}
    )


def assert_same(one, two):
    """All arrays of two files."""
    (stored, _), (other, _) = arrays(one), arrays(two)
    assert set(stored) == set(other)
    for name in stored:
        np.testing.assert_array_equal(stored[name], other[name], err_msg=name)


def interrupt(*unused, **named):
    raise KeyboardInterrupt


def interrupted(patched, name, made, path, with_=interrupt):
    """Simulate, with an interrupt at some function."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(patched, name, with_)
        simulate(made, path)


def after(calls):
    """`ShoeboxEngine.trace`, interrupted after so many calls."""
    real, left = ShoeboxEngine.trace, [calls]

    def trace(self, *arguments, **named):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        time.sleep(0.1)
        return real(self, *arguments, **named)

    return trace


def test_file_equals_the_exact_room_and_its_paths_make_the_channel(tmp_path):
    outcome = simulate(plan(), tmp_path / "box.h5")
    stored, about = arrays(tmp_path / "box.h5")
    room = Room(
        np.zeros(3), np.array([6.0, 5, 3]), np.full(6, -0.6), np.array(SCENE.room["boxes_m"])
    )
    exact = trace_room(
        room, SCENE.transmitter_m, stored["rx_position"], SCENE.frequency_hz, max_order=3
    ).csi
    # the amplitude of a path is the carrier's on all tones: 20 of 2,400 MHz
    np.testing.assert_allclose(stored["csi"], exact, rtol=0.02, atol=1e-4 * np.abs(exact).max())
    assert room.contains(stored["rx_position"]).all()
    assert not (tmp_path / "box.h5.parts").exists()
    assert about["simulator"] == b"gsparc-shoebox" and about["spectrum_rows"] == 4
    assert json.loads(about["effects_json"])["depth"] == 3
    assert load_own(tmp_path / "box.h5").site.kind == "spectrum"
    assert check([str(tmp_path / "box.h5")]) == 0
    assert not outcome.convergence and outcome.facts["paths_per_receiver"] > 5
    assert 0 < about["simulate_s"] <= sum(outcome.seconds.values())
    paths = stored["path_offsets"]
    assert len(paths) == 61 and paths[-1] == len(stored["path_delay"]) == len(
        stored["path_direction"]
    )
    some = slice(*paths[7:9])
    tones = np.exp(-2j * np.pi * np.outer(stored["path_delay"][some], stored["frequency_hz"]))
    np.testing.assert_allclose(stored["path_gain"][some] @ tones, stored["csi"][7, 0], rtol=1e-4)


def test_file_is_read_as_spectra_and_as_channels(tmp_path):
    file = tmp_path / "box.h5"
    simulate(plan(csi=ArraySettings(rows=2, columns=2)), file)
    spectra, csi = read(file, "spectrum"), read(file, "csi")
    assert spectra.site.kind == "spectrum" and spectra.target.shape == (60, 18, 36)
    assert spectra.site.static_end == csi.site.static_end == "tx"
    assert spectra.site.array.shape == (16, 3) and csi.site.array.shape == (4, 3)
    assert csi.site.kind == "csi" and csi.target.shape == (60, 4, 4)
    assert spectra.site.sha256 != csi.site.sha256
    assert len(spectra.release_split[1]) == 18 and read(file).site.kind == "spectrum"
    with pytest.raises(DataError, match=r"dataset\.target=power.* holds spectrum and csi and rssi"):
        read(file, "power")


def test_file_is_read_as_powers(tmp_path):
    """Sums of path powers; where no path arrives, a power is below the weakest that was heard."""
    blocked = replace(SCENE, room={**SCENE.room, "boxes_m": [[[2.6, 0, 0], [3.0, 4.0, 3]]]})
    direct = replace(MIRROR, specular=False, depth=0)
    made = simulate(plan(scene=blocked, effects=direct), tmp_path / "box.h5").rows.arrays
    data = read(tmp_path / "box.h5", "rssi")
    power = made["received_power"]
    heard = power > 0
    assert data.site.kind == "rssi" and 0 < heard.sum() < 60 and data.site.convergence_error is None
    np.testing.assert_array_equal(data.censored, ~heard)
    powers = data.target[:, 0] * data.site.target_scale
    np.testing.assert_allclose(powers[heard], power[heard], rtol=1e-4)
    np.testing.assert_allclose(powers[~heard], power[heard].min(), rtol=1e-4)


def test_noise_has_the_stated_power_and_is_the_same_put_together_on_disk(tmp_path, monkeypatch):
    simulate(plan(), tmp_path / "clean.h5")
    disturbed = plan(effects=replace(MIRROR, noise_snr_db=20.0))
    simulate(disturbed, tmp_path / "noisy.h5")
    clean, noisy = (arrays(tmp_path / f"{name}.h5")[0]["csi"] for name in ("clean", "noisy"))
    ratio = 10 * np.log10(np.mean(np.abs(clean) ** 2) / np.mean(np.abs(noisy - clean) ** 2))
    assert ratio == pytest.approx(20, abs=1.5)
    data = read(tmp_path / "noisy.h5", "csi")
    measured = np.mean(np.abs(noisy - clean) ** 2) / data.site.target_scale**2
    assert data.noise_variance[0] == pytest.approx(measured, rel=0.3)
    monkeypatch.setattr(blocks, "BIG", 1024)
    simulate(disturbed, tmp_path / "disk.h5")
    assert_same(tmp_path / "noisy.h5", tmp_path / "disk.h5")


def test_interrupted_run_is_resumed(tmp_path):
    """Finished shards are not touched, every receiver is there once,
    the file is the uninterrupted one's.
    """
    simulate(plan(), tmp_path / "whole.h5")
    interrupted(ShoeboxEngine, "trace", plan(), tmp_path / "cut.h5", after(2))
    assert not (tmp_path / "cut.h5").exists()
    shards = sorted((tmp_path / "cut.h5.parts").glob("shard_*.npz"))
    before, seen, real = (
        [(s.stat().st_mtime_ns, s.read_bytes()) for s in shards],
        [],
        ShoeboxEngine.trace,
    )
    assert len(shards) == 2

    def watches(self, *arguments, **named):
        seen.append([(s.stat().st_mtime_ns, s.read_bytes()) for s in shards])
        return real(self, *arguments, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ShoeboxEngine, "trace", watches)
        simulate(plan(), tmp_path / "cut.h5")
    assert len(seen) == 2 and all(state == before for state in seen)
    assert_same(tmp_path / "whole.h5", tmp_path / "cut.h5")
    about, other = (arrays(tmp_path / f"{name}.h5")[1] for name in ("whole", "cut"))
    for varying in (about, other):
        del varying["content_sha256"]  # of simulate_s, too
    _, bill = about.pop("simulate_s"), other.pop("simulate_s")
    assert bill > 0.2  # what the killed run had spent on its two shards is in it
    assert about == other


MASTS = [{"name": "a", "position_m": [1.0, 1.5, 2.6]}, {"name": "b", "position_m": [5.0, 4.0, 2.5]}]


@pytest.mark.slow
def test_transmitters_are_stations_and_every_pair_is_there_once(tmp_path):
    """Interrupted and resumed; a place is tested on with all transmitters or with none."""
    both = plan(
        scene=replace(SCENE, transmitter_m=None, transmitters=MASTS),
        effects=replace(FEW_PROBES, full=Effects(depth=3)),
    )
    interrupted(ShoeboxEngine, "trace", both, tmp_path / "two.h5", after(5))
    assert (tmp_path / "two.h5.parts").exists()
    outcome = simulate(both, tmp_path / "two.h5")
    stored, _ = arrays(tmp_path / "two.h5")
    pairs = np.column_stack([stored["station"], stored["rx_position"]])
    assert len(np.unique(pairs, axis=0)) == len(pairs) == 120 and "tx_position" not in stored
    alone = simulate(plan(effects=outcome.effects), tmp_path / "one.h5")
    np.testing.assert_array_equal(stored["csi"][:60], arrays(tmp_path / "one.h5")[0]["csi"])
    assert alone.survey.places.tolist() == outcome.survey.places.tolist()
    data = read(tmp_path / "two.h5", "csi")
    assert data.site.stations.name == ("a", "b") and data.site.static_end == "tx"
    learn, test = (set(data.place[rows]) for rows in data.release_split)
    assert not learn & test
    draw_power_and_delay_spread(outcome, tmp_path / "plan.png")


def test_parts_of_another_simulation_are_refused(tmp_path):
    """Of other settings, or of another table of places: shards are kept by the number of a row."""
    table, out = tmp_path / "places.csv", tmp_path / "box.h5"
    listed = plan(scene=replace(SCENE, receivers={"kind": "file", "file": str(table)}))
    table.write_text("x,y,z\n1,1,1.2\n2,1,1.2\n3,1,1.2\n")
    interrupted(campaigns, "_trace_all", listed, out)
    for another in (plan(shard=20), listed):
        table.write_text("x,y,z\n1,1,1.2\n2,1,1.2\n3,4,1.2\n")
        refused("different simulation", simulate, another, out)


def test_existing_file_is_not_overwritten(tmp_path):
    (tmp_path / "box.h5").write_text("mine")
    refused("exists", simulate, plan(), tmp_path / "box.h5")
    assert (tmp_path / "box.h5").read_text() == "mine"


def test_auto_decides_verifies_and_is_drawn(tmp_path):
    outcome = simulate(plan(effects=FEW_PROBES), tmp_path / "box.h5")
    choice = outcome.decision.choice
    assert choice is not None and choice.verdict is not None and choice.verdict.kept
    assert (
        set(outcome.effects.enabled) == {"line_of_sight", "specular"}
        and 1 <= outcome.effects.depth < 4
    )
    stored = json.loads(arrays(tmp_path / "box.h5")[1]["auto"])
    assert [row["effect"] for row in stored["table"]] == [row.effect for row in choice.table]
    facts = summary_facts(outcome)
    assert facts["auto/verdict/met"] >= 0.95 and facts["auto/specular/kept"] is True
    assert "requirement met" in describe_choice(choice)
    assert choice_table(choice).row_count == len(choice.table)
    draw_power_and_delay_spread(outcome, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


class Rays(ShoeboxEngine):
    """Our own engine as if it had rays: fewer than all miss by `off`."""

    random, samples, off = True, None, 1.05

    def with_samples(self, samples):
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
    monkeypatch.setattr(campaigns, "COMPILING", 0)
    monkeypatch.setattr(campaigns, "TRIAL", 0)
    return AutoSettings(probes=64, held_back=64, full=MIRROR)


def test_fewer_rays_are_simulated_where_verified(tmp_path, monkeypatch):
    """The file says with how many; what was decided on has all of them,
    and is not in the solver's error.
    """
    asked, many = with_rays(monkeypatch, 1.05), replace(SCENE, num_receivers=200)
    whole = simulate(plan(scene=many, effects=replace(asked, rays=1.0)), tmp_path / "whole.h5")
    outcome = simulate(plan(scene=many, effects=asked), tmp_path / "fewer.h5")
    choice = outcome.decision.choice
    assert whole.decision.choice.samples is None and choice.samples == 90_000
    assert choice.verdict.kept and choice.verdict.error == pytest.approx(0.42, abs=0.01)
    (all_, _), (fewer, about) = (arrays(tmp_path / f"{name}.h5") for name in ("whole", "fewer"))
    assert (
        json.loads(about["sampling"])["samples"] == json.loads(about["auto"])["samples"] == 90_000
    )
    ratio = fewer["received_power"] / all_["received_power"]
    decided_on = np.isclose(ratio, 1.0, rtol=1e-5)
    assert 128 <= decided_on.sum() < 200
    np.testing.assert_allclose(ratio[~decided_on], 1.05**2, rtol=1e-4)
    assert outcome.convergence["convergence_error"] == pytest.approx(1e-4, rel=0.01)
    assert outcome.convergence["convergence_power_db"] == pytest.approx(
        20 * np.log10(1.01), rel=0.01
    )
    assert (
        "90,000 rays" in describe_choice(choice)
        and summary_facts(outcome)["auto/samples"] == 90_000
    )


def test_refuted_choice_is_not_simulated(tmp_path, monkeypatch):
    """A run said NOT MET and simulated the choice all the same."""
    real, full = campaigns.auto.verify_choice, replace(MIRROR, depth=4)

    def refuted(*arguments):
        choice = real(*arguments)
        return replace(choice, verdict=replace(choice.verdict, kept=False, met=0.9))

    monkeypatch.setattr(campaigns.auto, "verify_choice", refuted)
    settings = replace(FEW_PROBES, full=full)
    outcome = simulate(plan(effects=settings), tmp_path / "box.h5")
    assert outcome.effects == outcome.decision.choice.effects == full
    assert "NOT MET by less (line of sight, specular, depth" in describe_choice(
        outcome.decision.choice
    )


@pytest.mark.parametrize(
    "room, words",
    [
        ({"reflection": -0.5}, r"scene\.room\.size_m=None: a list of three lengths"),
        ({"size_m": [4, 3, 2], "hight": 3}, r"scene\.room\.hight: no such setting"),
        (
            {"size_m": [4, 3, 2], "boxes_m": [[[1, 1, 1], [0, 2, 2]]]},
            r"scene\.room\.boxes_m=.*lower corner",
        ),
    ],
)
def test_a_room_without_its_size_ended_in_a_key_error(tmp_path, room, words):
    refused(words, simulate, plan(scene=replace(SCENE, room=room)), tmp_path / "box.h5")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"builder": "conference_room"}, "exactly one of"),
        ({"num_receivers": 3}, "at least 20"),
        ({"area_m": ((2.65, 2.25), (2.95, 2.55))}, "0 of 60 receivers"),
        ({"transmitter_m": (9.0, 1.0, 1.0)}, "outside the room"),
        ({"transmitter_m": (9.0, 1.0)}, "three finite numbers"),
        ({"transmitters": [{"position_m": [1, 1, 1]}]}, "not both"),
        ({"transmitter_m": None, "transmitters": []}, "one transmitter or more"),
        (
            {"transmitter_m": None, "transmitters": [{"position_m": [1, 1, 1], "sectors": 3}]},
            "isotropic",
        ),
        ({"over": "sea"}, "over='sea': one of zero"),
        ({"receivers": {"knd": "grid"}}, "no such setting"),
    ],
)
def test_bad_scenes_are_refused(tmp_path, changes, words):
    scene = {**vars(SCENE), **changes}
    refused(words, lambda: simulate(plan(scene=SceneSettings(**scene)), tmp_path / "box.h5"))
    assert not list(tmp_path.iterdir())
