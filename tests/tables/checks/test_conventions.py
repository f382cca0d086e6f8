"""Files that follow other conventions than the schema's: named,
and mended by the setting that is named.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from releases import real

from gsparc.base.errors import DataError
from gsparc.datasets.own import Own, read_any
from gsparc.tables.checks.conventions import convention_warnings
from gsparc.tables.own import from_arrays

LIGHT = 299_792_458.0
ROWS = 200


def channels(
    antennas: tuple[int, int] = (1, 1), tones: int = 16, band: float = 40e6
) -> dict[str, np.ndarray]:
    """A transmitter in a room with two walls, a planar array at rest."""
    rng = np.random.default_rng(1)
    frequency = 2.44e9 + (np.arange(tones) - tones // 2) * band / tones
    numbers = np.stack(np.meshgrid(*map(np.arange, antennas), indexing="ij"), -1).reshape(-1, 2)
    array = np.column_stack([numbers, 0 * numbers[:, 0]]) * 0.06
    place, still = (
        rng.uniform([0.5, 0.5, 0.8], [7.5, 5.5, 1.8], (ROWS, 3)),
        np.array([3.0, 2.0, 2.6]),
    )
    sources = [(1.0, place), (-0.4, place * [-1, 1, 1]), (-0.3, place * [1, -1, 1])]
    csi = 0.0
    for gain, source in sources:
        distance = np.linalg.norm(source[:, None] - still - array, axis=2)[..., None]
        csi = csi + gain * np.exp(-2j * np.pi * frequency * distance / LIGHT) / distance
    arrays = {"tx_position": place, "rx_position": still, "csi": csi, "frequency_hz": frequency}
    return arrays | ({"array_position": array} if len(array) > 1 else {})


def spectra() -> dict[str, np.ndarray]:
    """Beams about the transmitter, elevation and azimuth in steps of 5 and 10 degrees."""
    rng = np.random.default_rng(2)
    place = rng.uniform([-4, -4, 0.2], [4, 4, 3], (ROWS, 3))
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(0, 90, 5)), np.radians(np.arange(0, 360, 10)), indexing="ij"
    )
    level = np.cos(elevation)
    pixels = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1)
    unit = place / np.linalg.norm(place, axis=1, keepdims=True)
    beams = np.exp(30 * (np.einsum("hwc,sc->shw", pixels, unit) - 1)) + 0.01 * rng.random(
        (ROWS, *level.shape)
    )
    return {"tx_position": place, "rx_position": np.zeros(3), "spectrum": beams}


def delay_removed(arrays: dict[str, np.ndarray]) -> np.ndarray:
    distance = np.linalg.norm(arrays["tx_position"] - arrays["rx_position"], axis=1)
    away = arrays["frequency_hz"] - arrays["frequency_hz"].mean()
    return arrays["csi"] * np.exp(2j * np.pi * away * distance[:, None] / LIGHT)[:, None]


WIDE = {"antennas": (1, 1)}
SQUARE, LONG = {"antennas": (4, 4), "tones": 4}, {"antennas": (8, 1), "tones": 8}
OF_CSI = {
    "conjugate": (WIDE, lambda a: {"csi": a["csi"].conj()}),
    "swap_iq": (WIDE, lambda a: {"csi": a["csi"].imag + 1j * a["csi"].real}),
    "fft_order": (WIDE, lambda a: {"csi": np.fft.ifftshift(a["csi"], axes=2)}),
    "reverse_tones": (WIDE, lambda a: {"csi": a["csi"][:, :, ::-1]}),
    "delays_removed": (WIDE, lambda a: {"csi": delay_removed(a)}),
    "reverse_antennas": (LONG, lambda a: {"csi": a["csi"][:, ::-1]}),
    "exchange_axes": (LONG, lambda a: {"csi": a["csi"].swapaxes(1, 2)}),
    "array_mm": (SQUARE, lambda a: {"array_position": a["array_position"] * 1000}),
    "array_wavelengths": (
        SQUARE,
        lambda a: {"array_position": a["array_position"] * a["frequency_hz"].mean() / LIGHT},
    ),
}
OF_SPECTRA = {
    "zenith": lambda v: v[:, ::-1],
    "clockwise": lambda v: np.roll(v[:, :, ::-1], 1, axis=2),
    "azimuth_180": lambda v: np.roll(v, 18, axis=2),
    "azimuth_north": lambda v: np.roll(v, -9, axis=2),
    "transposed": lambda v: v.swapaxes(1, 2),
    "decibels": lambda v: 10 * np.log10(1 + 1000 * v),
}


def settings(warnings: list[str]) -> list[str]:
    return re.findall(r"dataset\.(\w+)=true", " ".join(warnings))


def mended_by(tmp_path: Path, damaged: dict[str, np.ndarray], name: str):
    path = tmp_path / "damaged.npz"
    np.savez(path, **damaged)
    return Own(path, **{name: True}).load()


@pytest.mark.parametrize("name", OF_CSI)
def test_another_convention_of_channels_was_good(tmp_path, name):
    case, damage = OF_CSI[name]
    clean = channels(**case)
    assert convention_warnings(from_arrays(clean)) == []
    damaged = clean | damage(clean)
    said = settings(convention_warnings(from_arrays(damaged)))
    assert said[0] == ("conjugate" if name == "swap_iq" else name)
    assert name != "exchange_axes" or "conjugate" not in said
    data, right = mended_by(tmp_path, damaged, name), from_arrays(clean)
    assert convention_warnings(data) == []
    measured = True if data.mask is None else data.mask
    np.testing.assert_allclose(
        (data.target * data.site.target_scale)[measured is True or measured],
        (right.target * right.site.target_scale)[measured is True or measured],
        atol=1e-4,
    )
    if right.site.array is not None:
        np.testing.assert_allclose(data.site.array, right.site.array, atol=1e-9)


@pytest.mark.parametrize("name", OF_SPECTRA)
def test_another_convention_of_spectra_was_good(tmp_path, name):
    clean = spectra()
    assert convention_warnings(from_arrays(clean)) == []
    damaged = clean | {"spectrum": OF_SPECTRA[name](clean["spectrum"])}
    assert settings(convention_warnings(from_arrays(damaged)))[:1] == [name]
    data = mended_by(tmp_path, damaged, name)
    assert convention_warnings(data) == []
    assert data.target.shape == (ROWS, 18, 36)


def test_tones_before_antennas_were_refused_without_what_to_say(tmp_path):
    """`frequency_hz: expected shape () or (K,), here () or (2,), found (16,)`,
    with `exchange_axes`, too.
    """
    clean = channels()
    turned = clean | {
        "csi": clean["csi"].swapaxes(1, 2),
        "mask": np.ones_like(clean["csi"], bool).swapaxes(1, 2),
    }
    with pytest.raises(DataError, match=r"say dataset\.exchange_axes=true") as refused:
        from_arrays(turned)
    assert len(refused.value.problems) == 1
    np.testing.assert_array_equal(
        mended_by(tmp_path, turned, "exchange_axes").target, from_arrays(clean).target
    )


def test_offsets_beside_a_carrier_were_refused():
    clean = channels()
    offsets = clean | {
        "frequency_hz": clean["frequency_hz"] - 2.44e9,
        "carrier_hz": np.array(2.44e9),
    }
    np.testing.assert_allclose(from_arrays(offsets).site.subcarriers_hz, clean["frequency_hz"])
    with pytest.raises(DataError, match="not MHz"):
        from_arrays(
            clean | {"frequency_hz": clean["frequency_hz"] / 1e6, "carrier_hz": np.array(2.44e9)}
        )


def test_real_files_are_sound_and_conjugated_channels_are_not():
    path = real("real/techtile-csi-920mhz.npz")
    others = ("newrf-conference.npz", "rfid-s23-160", "ofdm/wsr-nlos-a.npz")
    for each in (path, *map(real, others)):
        assert convention_warnings(read_any(each).data) == []
    arrays = dict(np.load(path))
    arrays["station_position"] = arrays.pop("rx_antenna_position")
    wrong = from_arrays(arrays | {"csi": arrays["csi"].conj()})
    assert settings(convention_warnings(wrong)) == ["conjugate"]
