from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsparc.field.losses import WINDOW_RADIUS
from gsparc.tables.own import SSIM_WINDOW, from_arrays, load_own, write_own


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_round_trip(tmp_path, csi_arrays, suffix):
    path = tmp_path / f"mine{suffix}"
    mask = np.ones((12, 2, 3), dtype=bool)
    mask[3, 0] = False
    csi_arrays["csi"][3, 0] = np.nan
    arrays = {
        **csi_arrays,
        "mask": mask,
        "noise_variance": np.float64(0.02),
        "position_std": np.linspace(0, 0.1, 12),
        "row_name": np.array(["ä"] * 12),
    }
    written = write_own(
        path, arrays, {"name": "garage", "operator": "me", "convergence_error": 0.01}
    )
    read = load_own(path)
    assert read.site.sha256 == written.site.sha256 and read.site.name == "garage"
    assert read.site.static_end == "tx" and read.target.shape == (12, 2, 3)
    assert read.target.dtype == np.complex64
    assert read.provenance == {"operator": "me"} and read.site.convergence_error == 0.01
    assert read.row_names[0] == "ä" and not read.mask[3, 0].any()
    physical = read.target * read.site.target_scale
    np.testing.assert_allclose(physical[mask], csi_arrays["csi"][mask], rtol=1e-6)
    assert 0.85 < np.mean(np.abs(read.target[mask]) ** 2) < 1.2
    np.testing.assert_allclose(read.noise_variance * read.site.target_scale**2, 0.02, rtol=1e-6)
    assert np.array_equal(read.position_std, arrays["position_std"])
    assert np.array_equal(read.subset(np.arange(3)).position_std, arrays["position_std"][:3])


def test_an_array_called_place_was_ignored_and_yet_decided_the_split(csi_arrays):
    plain, more = (from_arrays({**csi_arrays, **own}) for own in ({}, {"place": np.zeros(12)}))
    assert more.place is None and more.site.sha256 == plain.site.sha256


def test_a_subset_of_rows_without_names_was_an_index_error(csi_arrays):
    read = replace(from_arrays(csi_arrays), row_names=[])
    assert len(read.subset(np.arange(3))) == 3


def test_images_smaller_than_the_losses_window_are_noted():
    """The two numbers must be one: data do not know of losses."""
    assert SSIM_WINDOW == 2 * WINDOW_RADIUS + 1


def test_orientation_is_scalar_first_and_local_to_world(csi_arrays):
    turn = Rotation.from_euler("z", 90, degrees=True)
    data = from_arrays({**csi_arrays, "rx_orientation": turn.as_quat(scalar_first=True)})
    np.testing.assert_allclose(data.rx_rotation[5] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    same = {k: v for k, v in csi_arrays.items() if k != "rx_orientation"}
    same["rx_rotation"] = turn.as_matrix()
    np.testing.assert_allclose(from_arrays(same).rx_rotation, data.rx_rotation, atol=1e-12)


def test_directions_from_last_points(csi_arrays):
    offsets = np.arange(13) * 2
    points = np.repeat(csi_arrays["rx_position"], 2, axis=0) + np.array([0.0, 0, 5.0])
    data = from_arrays({**csi_arrays, "path_offsets": offsets, "path_last_point": points})
    assert len(data.directions) == 12 and data.directions[0].shape == (2, 3)
    np.testing.assert_allclose(
        np.concatenate(data.directions), np.tile([0, 0, 1], (24, 1)), atol=1e-6
    )
    # Rolled by 90 degrees about x, the receiver's y axis is the world's z: up is along its y.
    rolled = {
        **csi_arrays,
        "rx_orientation": Rotation.from_euler("x", 90, degrees=True).as_quat(scalar_first=True),
    }
    data = from_arrays({**rolled, "path_offsets": offsets, "path_last_point": points})
    np.testing.assert_allclose(
        np.concatenate(data.directions), np.tile([0, 1, 0], (24, 1)), atol=1e-6
    )


def test_a_refused_file_is_not_written(tmp_path, csi_arrays, refused):
    csi_arrays["csi"][0, 0, 0] = np.inf
    refused("row 0", write_own, tmp_path / "bad.h5", csi_arrays)
    assert list(tmp_path.iterdir()) == []


def test_rows_that_were_logged_twice_moved_the_origin():
    """Places were others by the bits then, and what was drawn of them another sample."""
    rng = np.random.default_rng(0)
    rows, twice = np.arange(80), np.r_[0:80, 60:80, 60:80]
    latitude, longitude = 48 + np.sort(rng.uniform(0, 0.02, 80)), rng.uniform(2, 2.02, 80)

    def drive(part):
        degrees = {"latitude": latitude[part], "longitude": longitude[part], "rx_height": 1.5}
        return from_arrays({**degrees, "rssi_db": np.linspace(-90, -50, 80)[part]})

    whole, copied = drive(rows), drive(twice)
    assert copied.site.georeference == whole.site.georeference
    assert np.array_equal(copied.site.origin, whole.site.origin)
