"""Scatterers: found where they are and told from images, and not invented where there are none."""

import numpy as np
import pytest
from gains import fitted
from rooms import WAVELENGTH, shoebox
from scenes import error
from shoeboxes import as_arrays

from gsparc.data.own import from_arrays
from gsparc.models.image_sources.rows import box_of, scatterers

SCATTERERS = np.array([[2.3, 0.9, 0.8], [1.1, 1.9, 1.2]])


def _room(extra=None):
    """A room of weak walls, and what `extra(tx, rx)` adds to its channels."""
    told, data, fold = shoebox(220, size=(3.0, 2.5, 2.2), max_order=1, reflection=-0.4)
    if extra is None:
        return told, data, fold
    arrays = as_arrays(told)
    arrays["csi"] = arrays["csi"] + extra(told.tx[0], told.rx)[:, None, None] * WAVELENGTH / (4 * np.pi)
    return told, from_arrays(arrays), fold


def _scattered(tx, rx):
    """Both legs, 1 / (d1 d2)."""
    before = np.linalg.norm(SCATTERERS - tx, axis=1)
    after = np.linalg.norm(rx[:, None] - SCATTERERS[None], axis=-1)
    return 0.5 * (np.exp(-2j * np.pi * (before + after) / WAVELENGTH) / before / after).sum(1)


def test_without_scatterers_none_is_invented(tmp_path):
    _, data, fold = _room()
    method, report = fitted(data, fold, tmp_path, clutter=False)
    assert error(method, data, fold.test) < 0.01 and "0 scatterers" in " ".join(report.notes)


@pytest.mark.slow
def test_scatterers_are_found_and_told_from_images(tmp_path):
    told, data, fold = _room(_scattered)
    method, _ = fitted(data, fold, tmp_path, clutter=False)
    scene = method.members[0].scene
    places = (scene.sources + method.frame.middle).numpy() + data.site.origin
    scattered = scatterers(scene.sources, box_of(method.members[0].rows, scene.transmitter)).numpy()
    inside = places[scattered]
    nearest = np.linalg.norm(SCATTERERS[:, None] - inside[None], axis=-1).min(1)
    assert (nearest < 0.1 * WAVELENGTH).all() and error(method, data, fold.test) < 0.01
    images = told.images.of(told.tx[0])[told.images.order == 1]
    outside = places[~scattered]
    assert (np.linalg.norm(images[:, None] - outside[None], axis=-1).min(1) < 0.3 * WAVELENGTH).all()
