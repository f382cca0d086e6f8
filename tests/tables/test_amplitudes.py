"""Channels of which amplitudes alone were logged."""

import numpy as np
import pytest

from gsparc.datasets.own import apply_settings
from gsparc.tables.other_names import amplitudes_to_levels
from gsparc.tables.own import from_arrays, interpret
from gsparc.tables.raw import Raw
from gsparc.tables.read import parse_table

RNG = np.random.default_rng(0)
PLACES, END = RNG.uniform(0, 5, (20, 3)), np.array([1.0, 2, 3])
AMPLITUDE = RNG.uniform(0.1, 2, (20, 2, 4))
TONES = 2.4e9 + 312.5e3 * np.arange(4)


def test_amplitudes_without_phases_were_refused():
    """As ESP32, Intel and Nexmon logs are kept: |h| of two antennas and four tones,
    one of them a guard.
    """
    amplitude = AMPLITUDE * [1, 1, 0, 1]
    amplitude[3, 0, 0] = 0
    data = from_arrays(
        {"rx_position": PLACES, "tx_position": END, "csi": amplitude, "frequency_hz": TONES}
    )
    names = [f"antenna {a} tone {k}" for a in (0, 1) for k in (0, 1, 3)]
    assert data.site.kind == "rssi" and [*data.site.stations.name] == names
    np.testing.assert_allclose(data.site.stations.carrier_hz, np.tile(TONES[[0, 1, 3]], 2))
    np.testing.assert_allclose(data.tx + data.site.origin, np.tile(END, (len(data), 1)), atol=1e-6)
    first = (data.station == 1) & (data.place == data.place[0])
    power = data.target[first][0, 0] * data.site.target_scale
    np.testing.assert_allclose(np.sqrt(power), amplitude[0, 0, 1], rtol=1e-5)
    heard = np.ones(len(data), bool) if data.mask is None else data.mask[:, 0]
    assert heard.sum() == 20 * 6 - 1


@pytest.mark.parametrize("name", ["csi_amplitude", "magnitude"])
def test_names_of_amplitudes_were_unknown(name):
    reading = interpret(Raw({"rx_position": PLACES, name: AMPLITUDE[:, 0]}), "file")
    assert len(reading.data.site.stations) == 4 and ("absolute values, no phases") in " ".join(
        reading.notes
    )


PHASE = RNG.uniform(-3, 3, AMPLITUDE.shape)


@pytest.mark.parametrize(
    "held",
    [
        {"amplitude": AMPLITUDE, "phase": PHASE},
        {"csi_mag": AMPLITUDE, "csi_phase_deg": np.degrees(PHASE)},
        {"amplitude_db": 20 * np.log10(AMPLITUDE), "phase_rad": PHASE},
        {"csi_real": AMPLITUDE * np.cos(PHASE), "csi_imag": AMPLITUDE * np.sin(PHASE)},
    ],
)
def test_phases_beside_amplitudes_were_ignored(held):
    arrays = {"rx_position": PLACES, "tx_position": END, "frequency_hz": TONES, **held}
    data = interpret(Raw(arrays), "file").data
    np.testing.assert_allclose(
        data.target * data.site.target_scale, AMPLITUDE * np.exp(1j * PHASE), atol=1e-5
    )


def test_a_carrier_and_a_spacing_say_what_a_list_of_tones_does():
    arrays = {"rx_position": PLACES, "tx_position": END, "csi": AMPLITUDE * np.exp(1j * PHASE)}
    middle = {"center_frequency": np.array(TONES[2]), "subcarrier_spacing": np.array(312.5e3)}
    np.testing.assert_allclose(
        interpret(Raw(arrays | middle), "file").data.site.subcarriers_hz, TONES
    )
    raw = apply_settings(Raw(arrays), carrier_hz=TONES[2], spacing_hz=312.5e3)
    np.testing.assert_allclose(interpret(raw, "file").data.site.subcarriers_hz, TONES)


@pytest.mark.parametrize(
    "changes",
    [
        {"csi": AMPLITUDE + 0j},
        {"csi": AMPLITUDE - 1},
        {"tx_position": PLACES + 1},
        {"station": np.zeros(20, int)},
    ],
)
def test_what_is_no_amplitude_of_one_static_end_is_left_alone(changes):
    raw = Raw({"rx_position": PLACES, "tx_position": END, "csi": AMPLITUDE, **changes})
    assert amplitudes_to_levels(raw) is raw


def test_a_table_of_amplitudes_was_refused_once_for_each_tone(tmp_path, refused):
    """`amp_0 has no csi_phase beside it`, 52 times."""
    file = tmp_path / "walk.csv"

    def written(offset, stem="amp_"):
        rows = [
            ",".join(f"{v:.4f}" for v in (*p, *a))
            for p, a in zip(PLACES, AMPLITUDE[:, 0] - offset, strict=True)
        ]
        file.write_text("\n".join([f"x,y,z,{','.join(f'{stem}{k}' for k in range(4))}", *rows]))
        return file

    table = parse_table(written(0))
    data = interpret(table, file).data
    assert data.site.kind == "rssi" and [*data.site.stations.name] == [
        f"tone {k}" for k in range(4)
    ]
    refused(r"amplitudes below 0: levels\? say dataset\.columns\.rssi_db", parse_table, written(3))
    way = "rssi_db='subcarrier*' (levels) or .csi_amp='subcarrier*' (amplitudes)"
    refused(way, parse_table, written(0, "subcarrier"))
    again = interpret(parse_table(written(0, "subcarrier"), {"csi_amp": "subcarrier*"}), file).data
    assert again.site.sha256 == data.site.sha256


def test_columns_of_beams_were_no_levels(tmp_path):
    file = tmp_path / "beams.csv"
    file.write_text(
        "x,y,beam_0,beam_1\n" + "".join(f"{i},{i * i},-{70 + i},-{80 - i}\n" for i in range(6))
    )
    assert [*interpret(parse_table(file), file).data.site.stations.name] == ["beam_0", "beam_1"]


def test_beams_of_both_ends_were_advised_one_after_the_other(tmp_path):
    file = tmp_path / "sweep.csv"
    rows = [
        f"{i},{i * i},{t},{r},-{60 + i + 3 * t + r}"
        for i in range(12)
        for t in range(3)
        for r in range(2)
    ]
    file.write_text("\n".join(["x,y,tx_beam,rx_beam,rsrp", *rows]))
    said = [
        note
        for note in interpret(parse_table(file), file).notes
        if "is not used, but with it" in note
    ]
    assert len(said) == 2 and "device=tx_beam+rx_beam takes each off" in said[1]
    data = interpret(parse_table(file, {"station": "tx_beam+rx_beam"}), file).data
    assert len(data.site.stations) == 6
    found = interpret(parse_table(file, {"device": "tx_beam+rx_beam"}), file)
    assert len(found.data.site.device_names) == 6 and not any(
        "but with it" in note for note in found.notes
    )
