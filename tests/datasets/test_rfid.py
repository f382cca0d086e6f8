import logging

import numpy as np
import pytest
import torch
from PIL import Image
from poses import boresight_degrees
from releases import release

from gsparc.datasets.load import load, split_for
from gsparc.datasets.rfid import WAVELENGTH, load_rfid, planar_array
from gsparc.models.station_sites import station_site


def test_tiny_folder(rfid_folder):
    data = load_rfid(rfid_folder)
    assert data.target.shape == (6, 90, 360) and data.target.dtype == np.uint8
    assert (
        data.site.kind == "spectrum"
        and data.site.static_end == "rx"
        and data.site.moving_end == "tx"
    )
    assert data.site.wavelength == pytest.approx(0.3259)
    assert [r.tolist() for r in data.release_split] == [[0, 2, 3, 5], [1, 4]]
    np.testing.assert_allclose(data.tx + data.site.origin, [[0.1 * i, 0.2, 1.0] for i in range(6)])
    np.testing.assert_allclose(data.site.box[0], -data.site.box[1])
    batch = data.batch(np.array([4, 0]))
    assert not batch.rx.batched and batch.index.tolist() == [4, 0] and batch.target.max() <= 1
    torch.testing.assert_close(
        batch.rx.position + torch.from_numpy(data.site.origin).float(),
        torch.tensor([5.0, 0.26, 0.0]),
    )


def _pixel_under_tag(data, shift=0):
    elevation, azimuth = boresight_degrees(data)
    row = np.round(elevation).astype(int).clip(0, 89)
    column = (np.round(azimuth).astype(int) + shift) % 360
    return data.target[np.arange(len(data)), row, column] / 255


def test_pose_real_tags_sit_on_bright_pixels():
    data = load_rfid(release("rfid-s23-160"))
    elevation, _ = boresight_degrees(data)
    assert elevation.min() > 75 and elevation.max() < 81
    assert _pixel_under_tag(data).mean() > 0.6
    assert 0.38 < data.target.mean() / 255 < 0.46
    # The test can fail: half a turn off, as one published loader is, little is left.
    assert _pixel_under_tag(data, shift=180).mean() < 0.6


def _residual(image, wavelength, spacing, first_row, first_column=0):
    """Root mean square of what the 49 lags of a 4 x 4 array leave of the squared image."""
    rows, columns = np.meshgrid(np.arange(2, 90, 5), np.arange(0, 360, 9), indexing="ij")
    elevation, azimuth = (
        np.radians(rows.ravel() + first_row),
        np.radians(columns.ravel() + first_column),
    )
    u, v = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    lags = [(a, b) for a in range(-3, 4) for b in range(-3, 4) if (a, b) >= (0, 0)]
    phase = [2 * np.pi * spacing / wavelength * (a * u + b * v) for a, b in lags]
    basis = np.stack([np.cos(p) for p in phase] + [np.sin(p) for p in phase[1:]], axis=1)
    squared = (image[rows, columns].ravel() / 255.0) ** 2
    return np.sqrt(np.mean((squared - basis @ np.linalg.lstsq(basis, squared, rcond=None)[0]) ** 2))


def test_array_and_grid_explain_real_spectra_to_the_quantisation_floor():
    data = load_rfid(release("rfid-s23-160"))
    spacing = float(np.diff(np.unique(planar_array()[:, 0]))[0])
    chosen = data.target[::40]
    ours = np.mean([_residual(im, WAVELENGTH, spacing, 0) for im in chosen])
    assert ours < 2e-3
    assert np.mean([_residual(im, WAVELENGTH, spacing, 1) for im in chosen]) > 3 * ours
    assert np.mean([_residual(im, WAVELENGTH * 1.02, spacing, 0) for im in chosen]) > 3 * ours


def test_absent_release_is_loud_and_uses_the_stand_in(tmp_path, caplog):
    config = {
        "name": "rfid",
        "root": None,
        "stand_in": {"count": 4, "seed": 0, "root": str(tmp_path / "stand-ins")},
    }
    with caplog.at_level(logging.WARNING):
        data = load(config)
    assert data.site.name == "rfid-sim" and data.site.stand_in == "rfid"
    text = caplog.text
    assert "NOT on disk" in text and "XPengZhao/NeRF2" in text and "rfid-sim" in text


@pytest.mark.parametrize("name", ["rfid", "argos"])
def test_a_mistyped_root_was_another_dataset(name, tmp_path, refused):
    """The stand-in took the place of any folder that is not there."""
    refused(
        r"nowhere (does not exist|is not there)",
        load,
        {"name": name, "root": str(tmp_path / "nowhere")},
    )


def test_a_moving_receiver_s_folder_is_read(rfid_folder, refused):
    """The layout of the paper's room: rx_pos.csv, spectra as arrays, the gateway transmits."""
    (rfid_folder / "tx_pos.csv").rename(rfid_folder / "rx_pos.csv")
    images = load_rfid_images(rfid_folder)
    data = load_rfid(rfid_folder)
    assert data.site.moving_end == "rx" and data.target.dtype == np.float32
    assert data.site.wavelength is None and data.row_names[2] == "spectrum/00003.npy"
    np.testing.assert_allclose(data.target, images, atol=1e-6)
    np.testing.assert_allclose(data.tx[3] + data.site.origin, [5.0, 0.26, 0.0])
    np.testing.assert_allclose(
        data.rx_position + data.site.origin, [[0.1 * i, 0.2, 1.0] for i in range(6)]
    )
    assert data.batch(np.array([4, 0])).rx.batched
    np.save(rfid_folder / "spectrum" / "00002.npy", 1.5 * images[1])
    refused(r"00002.npy: expected an array of 90 x 360 numbers from 0 to 1", load_rfid, rfid_folder)


def load_rfid_images(folder):
    """Images of a folder (S, 90, 360) in [0, 1], rewritten there as arrays."""
    images = []
    for path in sorted((folder / "spectrum").glob("*.png")):
        with Image.open(path) as image:
            images.append(np.asarray(image, np.float32) / 255)
        np.save(path.with_suffix(".npy"), images[-1])
        path.unlink()
    return np.stack(images)


def test_carriers_of_rows_were_mixed_as_repeats(rfid_folder):
    """The layout of many carriers: a station for each, places together, zenith angles,
    clockwise azimuths.
    """
    plain = load_rfid(rfid_folder).target
    (rfid_folder / "freq.txt").write_text("1\n5\n60\n1\n5\n60\n")
    tags = [[0.5 * (i // 3), 0.2, 1.0] for i in range(6)]
    (rfid_folder / "tx_pos.csv").write_text(
        "x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in tags)
    )
    data = load_rfid(rfid_folder)
    assert data.site.stations.name == ("1 GHz", "5 GHz", "60 GHz")
    assert data.carrier_hz.tolist() == [1e9, 5e9, 60e9] * 2 and data.place.tolist() == [
        0,
        0,
        0,
        1,
        1,
        1,
    ]
    np.testing.assert_array_equal(data.target, plain[:, ::-1, ::-1])
    assert data.site.grid.elevations().rad2deg()[[0, -1]].tolist() == pytest.approx([1, 90])
    own = station_site(data.site, 2)
    assert own.carrier_hz == 60e9 and np.ptp(own.array[:, 0]) == 0
    assert np.ptp(own.array[:, 1]) / own.wavelength == pytest.approx(1.5)
    folds = split_for({"name": "carriers"}, data).folds
    assert [data.carrier_hz[fold.test].tolist() for fold in folds] == [
        [1e9] * 2,
        [5e9] * 2,
        [60e9] * 2,
    ]


@pytest.mark.parametrize("text", ["1\n60\n", "1 1 1 1 1 x", "1 1 1 1 1 6e10"])
def test_carriers_that_are_none_are_refused(rfid_folder, text, refused):
    (rfid_folder / "freq.txt").write_text(text)
    refused(
        r"freq.txt: . words; expected the carrier of each of the 6 rows", load_rfid, rfid_folder
    )
