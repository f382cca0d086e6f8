"""The Argos layout: what is read, what is refused, and what aligning may not change."""

import shutil

import numpy as np
import pytest
from cities import city, folder

from gsparc.datasets.argos import TONES, load_argos, remove_uplink_offsets
from gsparc.datasets.load import load


def _copy(tmp_path, *without: str):
    place = tmp_path / "argos"
    place.mkdir()
    for name in ("csidata.npy", "base-station.yml"):
        if name not in without:
            shutil.copy(folder() / name, place)
    return place


def test_reads_the_release_s_two_files(tmp_path) -> None:
    data = load_argos(_copy(tmp_path))
    assert data.target.shape[1:] == (1, 26) and data.uplink.shape[1:] == (8, 26)
    assert data.site.moving_end == "rx" and data.site.kind == "csi"
    assert np.allclose(np.diff(data.site.subcarriers_hz), 312.5e3)


def test_aligning_takes_phase_and_timing_and_nothing_else() -> None:
    csi = np.load(folder() / "csidata.npy")[:10].astype(np.complex128)
    tones = np.array(TONES, dtype=float)
    moved = csi * np.exp(1j * (1.3 - 0.2 * tones))
    assert np.allclose(
        remove_uplink_offsets(moved, tones), remove_uplink_offsets(csi, tones), atol=1e-12
    )
    assert np.allclose(np.abs(remove_uplink_offsets(csi, tones)), np.abs(csi))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: (p / "csidata.npy").unlink(), "csidata.npy: missing"),
        (lambda p: np.save(p / "csidata.npy", np.zeros((4, 8, 52))), "expected complex"),
        (lambda p: np.save(p / "csidata.npy", np.full((4, 8, 52), np.nan + 0j)), "snapshot 0: NaN"),
        (lambda p: np.save(p / "csidata.npy", np.zeros((4, 8, 52), complex)), "uplink is silent"),
        (lambda p: (p / "base-station.yml").write_text("base_station: [1, 2]"), "expected 8 x 3"),
        (lambda p: (p / "base-station.yml").write_text("- 1"), "expected `base_station:`"),
        (
            lambda p: [(p / f"{n}_index.txt").write_text("0 1") for n in ("train", "test")],
            "also in train",
        ),
    ],
)
def test_bad_folders_are_refused_in_words(tmp_path, change, words, refused) -> None:
    place = _copy(tmp_path)
    change(place)
    refused(words, load_argos, place)


def test_no_such_antenna_or_positions(tmp_path, refused) -> None:
    refused("at least 0 and at most 63, or all", city, 64)
    refused(
        "true positions exist in the stand-in only", load_argos, _copy(tmp_path), positions="true"
    )


def _without_third(places: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(places))[:, None] == 2, np.nan, places)


@pytest.mark.parametrize(
    ("change", "words"), [(_without_third, "row 2"), (np.transpose, r"transposed\?")]
)
def test_positions_that_are_none_are_refused(tmp_path, change, words, refused) -> None:
    place = shutil.copytree(folder(), tmp_path / "city")
    np.save(place / "positions.npy", change(np.load(place / "positions.npy")))
    refused(words, load_argos, place, positions="true")


def test_absent_release_is_loud(caplog) -> None:
    stand_in = {"root": str(folder().parent), "count": 120, "seed": 1}
    data = load({"name": "argos", "root": None, "stand_in": stand_in})
    assert "SIMULATED" in caplog.text and data.site.stand_in == "argos"
    assert data.moving.shape == (120, 3) and np.ptp(data.moving) > 0
