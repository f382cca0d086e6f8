"""One wrong row among many: named, without a say in scales, left out when asked for."""

import numpy as np
import pytest
from campaigns import channels, powers, spectra

from gsparc.commands.check import main as check
from gsparc.data.outliers import find_outliers, too_far
from gsparc.data.scale import find_strong_outliers
from gsparc.datasets.load import load, split_for

MAKERS = {"spectrum": spectra, "csi": channels, "rssi": powers}
KINDS = pytest.mark.parametrize("kind", MAKERS)


def arrays_of(file):
    with np.load(file) as stored:
        return {name: stored[name].copy() for name in stored.files}


def loaded(folder, arrays):
    np.savez(folder / "own.npz", **arrays)
    return load({"name": "own", "file": str(folder / "own.npz")})


def spoilt(kind, folder, row, factor=1.0):
    """A clean file and one whose measurement was changed in one row; both as measurements."""
    arrays = arrays_of(MAKERS[kind](folder / "clean.npz"))
    clean = loaded(folder, arrays)
    if "rssi_db" in arrays:
        arrays["rssi_db"][row] += 10 * np.log10(factor)
    else:
        arrays[kind][row] = arrays[kind][row] * factor
    return clean, loaded(folder, arrays)


@KINDS
def test_one_row_at_1e8_rescales_nothing(kind, tmp_path, caplog, capsys):
    """PSNR rose to 51 dB while the NMSE was 7e13, without a warning; `gsparc check` said good."""
    clean, wrong = spoilt(kind, tmp_path, 5, 1e8)
    others = np.delete(np.arange(len(clean)), 5)
    assert wrong.site.target_scale == clean.site.target_scale
    assert np.array_equal(wrong.target[others], clean.target[others])
    assert "row 5: measure far more power than all others" in caplog.text
    assert check([str(tmp_path / "own.npz")]) == 0
    assert "row 5: measure far more power" in capsys.readouterr().out


@KINDS
def test_a_position_2e6_m_off_moves_nothing(kind, tmp_path, caplog):
    clean, _ = spoilt(kind, tmp_path, 0)
    arrays = arrays_of(tmp_path / "clean.npz")
    arrays[f"{clean.site.moving_end}_position"][7] += [2e6, 0, 0]
    wrong = loaded(tmp_path, arrays)
    assert np.allclose(wrong.site.origin, clean.site.origin, atol=0.5)
    assert np.ptp(wrong.site.box, axis=0).max() < 10
    assert "row 7: lie far outside the region of all others" in caplog.text


@pytest.mark.parametrize("split", ["random", "grouped", "corner", "sparse"])
def test_they_are_left_out_when_the_user_says_so(split, tmp_path):
    clean, wrong = spoilt("csi", tmp_path, 5, 1e8)
    assert find_outliers(wrong) and not find_outliers(clean)
    kept = split_for({"name": split, "leave_out": "outliers"}, wrong)
    for fold in kept.folds:
        assert 5 not in np.concatenate([fold.train, fold.val, fold.test])
    same = split_for({"name": split, "leave_out": [5]}, clean)
    assert same.sha256 == kept.sha256 != split_for({"name": split}, clean).sha256
    assert (
        split_for({"name": split, "leave_out": "outliers"}, clean).sha256
        == split_for({"name": split}, clean).sha256
    )


@pytest.mark.parametrize(
    "rows",
    [
        "outlier",
        "",
        [-1],
        [1.5],
        [999],
        3,
        None,
        True,
        [True],
        [[3]],
        {"3": 4},
        [10**20],
        np.array(3),
    ],
)
def test_rows_that_cannot_be_left_out_are_refused(rows, tmp_path, refused):
    """A single number, null and a number beyond 64 bits ended in words of Python and NumPy."""
    clean, _ = spoilt("rssi", tmp_path, 0)
    refused(r"split\.leave_out", split_for, {"name": "random", "leave_out": rows}, clean)


@pytest.mark.parametrize("rows", [np.array([3, 4]), [np.int64(3), np.uint8(4)], (3, 4)])
def test_rows_to_leave_out_may_be_numbers_of_numpy(rows, tmp_path):
    """An array, or numbers out of one, were refused."""
    clean, _ = spoilt("rssi", tmp_path, 0)
    expected = split_for({"name": "random", "leave_out": [3, 4]}, clean)
    assert split_for({"name": "random", "leave_out": rows}, clean).sha256 == expected.sha256


def test_real_dynamics_are_no_outliers():
    """Free space from 3 cm to 30 m is 60 dB, and a silent half leaves nothing suspicious."""
    distance = np.geomspace(0.03, 30, 200)
    assert not find_strong_outliers(1 / distance).any()
    assert not find_strong_outliers(np.where(np.arange(200) % 2, 1 / distance, 0)).any()
    assert not find_strong_outliers(np.zeros(9)).any()
    assert find_strong_outliers(np.append(1 / distance, 1e12)).nonzero()[0].tolist() == [200]
    track = np.stack([np.linspace(0, 5e3, 300), np.zeros(300), np.zeros(300)], 1)
    assert not too_far(track).any() and not too_far(np.zeros((5, 3))).any()


def test_a_row_beyond_float32_is_refused(tmp_path, refused):
    """Its target would be infinite, in units of the other rows."""
    refused(
        r"csi, row 5: beyond float32 in units of the other rows", spoilt, "csi", tmp_path, 5, 1e200
    )


@pytest.mark.parametrize(
    "others",
    [np.full(60, -200.0), -174 + np.sin(np.arange(60.0))],
    ids=["sentinel", "thermal floor"],
)
def test_rows_with_signal_are_no_outliers_among_rows_without(others):
    """Where most rows stood at a floor, all rows with signal were called outliers
    and left out of scale.
    """
    heard = np.linspace(-95, -50, 40)
    assert not find_strong_outliers(10 ** (np.concatenate([others, heard]) / 20)).any()
    assert find_strong_outliers(10 ** (np.append(heard, 20.0) / 20)).sum() == 1
