"""Powers as they are stored and in every unit that people give them in."""

import numpy as np
import pytest
import torch

from gsparc.data.units import LINEAR, PowerUnit
from gsparc.tables.own import from_arrays

# Of a stored power of 2 that times 3 has a level in the unit of levels: its value in another unit.
DB = 10 * np.log10(6)
VALUES = {
    ("dBm", "dBm"): DB,
    ("dBm", "dBW"): DB - 30,
    ("dBm", "mW"): 6,
    ("dBm", "W"): 6e-3,
    ("dBm", "uw"): 6e3,
    ("dBW", "dBm"): DB + 30,
    ("dBW", "fW"): 6e15,
    ("dBW", LINEAR): 6,
    ("dB", LINEAR): 6,
    ("dB", "dB"): DB,
    ("dB", "dBm"): DB,  # the user says what nobody said
}


@pytest.mark.parametrize(("level", "unit"), VALUES)
def test_values_deviations_and_back(level, unit):
    wanted = PowerUnit.from_name(unit, level, 3.0)
    power = torch.tensor([[2.0], [2.0 * 1.0001]])
    value = wanted.values(power)
    assert value[0].item() == pytest.approx(VALUES[level, unit], rel=1e-6)
    std = wanted.variance(power, torch.tensor([2e-4, 2e-4]).square()).sqrt()
    assert std[0].item() == pytest.approx((value[1] - value[0]).item(), rel=5e-3)
    torch.testing.assert_close(wanted.stored(value), power.double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("level", "unit", "levels", "said"),
    [
        ("dBm", "dBi", False, "unit=dBi: of powers in dBm expected dBm, dBW, linear, W, mW"),
        ("dBm", "dB", False, "expected dBm"),
        ("dB", "mW", False, "of powers in dB expected dBm, dBW, linear$"),
        ("dBm", "mW", True, "expected dBm, dBW$"),
        ("dBm", LINEAR, True, "expected dBm, dBW$"),
        ("dBm", "m", False, "expected dBm"),
        ("dBm", 3, False, "unit=3"),
    ],
)
def test_what_is_no_unit_of_these_powers_is_refused(level, unit, levels, said):
    with pytest.raises(ValueError, match=said):
        PowerUnit.from_name(unit, level, levels=levels)


def test_silence_has_no_level():
    values = PowerUnit.from_name("dBm", "dBm").values(torch.tensor([[0.0], [-1.0]]))
    assert values[0] == -np.inf and torch.isnan(values[1])


PLACES = {"rx_position": np.c_[np.arange(4.0), np.zeros(4), np.ones(4)], "tx_position": np.ones(3)}


@pytest.mark.parametrize(
    ("name", "about", "level", "unit"),
    [
        ("rssi", {}, "dBW", "W"),
        ("rssi", {"unit": "nW"}, "dBW", "nW"),
        ("rssi_db", {}, "dB", "dB"),
        ("rssi", {"level_unit": "dBm"}, "dBm", LINEAR),
        ("rssi", {"level_unit": "dB"}, "dB", LINEAR),
        ("rssi_db", {"level_unit": "dBm"}, "dBm", "dBm"),
        ("rssi_db", {"level_unit": "dBuV"}, "dBuV", "dBuV"),
    ],
)
def test_powers_in_watts_had_levels_in_db(name, about, level, unit):
    """Maps of watts said dB, and could not be compared with files in dBm."""
    data = from_arrays({**PLACES, name: np.arange(1.0, 5)}, about)
    own = data.site.power_unit()
    assert (data.site.level_unit, own.name) == (level, unit)
    given = np.arange(1.0, 5) * (1e9 if unit == "nW" else 1)
    assert np.allclose(own.values(data.targets(np.arange(4)))[:, 0], given)
