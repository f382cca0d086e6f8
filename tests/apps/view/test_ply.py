"""Splat files in the layout that viewers expect."""

import numpy as np
import pytest

from gsparc.apps.view.ply import FIELDS, Y00, write_ply
from gsparc.base.errors import DataError
from gsparc.data.site_objects import GaussianCloud


def cloud(count: int = 5) -> GaussianCloud:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    means, scales = rng.normal(size=(count, 3)), rng.uniform(0.1, 2, (count, 3))
    return GaussianCloud(means, scales, quats, rng.uniform(0, 1, count), np.ones(count), "emission")


def read_back(content: bytes) -> dict[str, np.ndarray]:
    """As any reader of PLY does: names out of the header, then rows of floats."""
    header, _, body = content.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    rows = np.frombuffer(body, "<f4").reshape(count, len(names))
    return dict(zip(names, rows.T, strict=True))


def test_every_field_says_what_a_splat_viewer_takes_it_for(tmp_path):
    made = cloud()
    made.opacities[:2] = [0, 1]
    colours = np.random.default_rng(1).integers(0, 256, (5, 3)).astype(np.uint8)
    write_ply(tmp_path / "a.ply", made, colours)
    found = read_back((tmp_path / "a.ply").read_bytes())
    assert tuple(found) == FIELDS
    np.testing.assert_allclose(np.column_stack([found[k] for k in "xyz"]), made.means, rtol=1e-6)
    scales = np.exp(np.column_stack([found[f"scale_{k}"] for k in range(3)]))
    np.testing.assert_allclose(scales, made.scales, rtol=1e-5)
    assert np.isfinite(found["opacity"]).all()
    np.testing.assert_allclose(
        1 / (1 + np.exp(-found["opacity"])), made.opacities, rtol=1e-5, atol=1e-4
    )
    rgb = 0.5 + Y00 * np.column_stack([found[f"f_dc_{k}"] for k in range(3)])
    np.testing.assert_allclose(rgb, colours / 255, atol=1e-6)
    turns = np.column_stack([found[f"rot_{k}"] for k in range(4)])
    np.testing.assert_allclose(turns, made.quats, atol=1e-6)


def test_none_and_what_is_not_finite_are_refused(tmp_path):
    bad = cloud(2)
    bad.means[0, 0] = np.nan
    for wrong in (cloud(0), bad):
        with pytest.raises(DataError, match="no Gaussians to write, or one is not finite"):
            write_ply(tmp_path / "a.ply", wrong, np.zeros((len(wrong), 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_covariances_are_those_of_turned_axes():
    half = np.pi / 4
    turned = GaussianCloud(
        np.zeros((1, 3)),
        np.array([[3.0, 1, 2]]),
        np.array([[np.cos(half), 0, 0, np.sin(half)]]),
        np.ones(1),
        np.ones(1),
        "",
    )
    np.testing.assert_allclose(turned.covariances()[0], np.diag([1.0, 9, 4]), atol=1e-12)
