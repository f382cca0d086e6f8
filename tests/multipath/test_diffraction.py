"""Edges and scatterers: found where they are, named, and not invented where there are none."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms import WAVELENGTH, nmse, shoebox
from shoeboxes import as_arrays

from gsparc.data.own import from_arrays
from gsparc.data.schema import LIGHT
from gsparc.methods.method import FitContext
from gsparc.multipath.diffraction import Edges, diffracted, edge_wave
from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.multipath.source_types import SourceKind, box_of, kinds

EDGE = torch.tensor([[1.9, 1.3, 1.0]], dtype=torch.float64)
UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
SCATTERERS = np.array([[2.3, 0.9, 0.8], [1.1, 1.9, 1.2]])
QUICK = {"searches": 1, "search_rows": 220, "margin": 4.0, "clutter": False}


def _room(extra=None):
    """A room of weak walls, and what `extra(tx, rx)` adds to its channels."""
    told, data, fold = shoebox(220, size=(3.0, 2.5, 2.2), max_order=1, reflection=-0.4)
    if extra is None:
        return told, data, fold
    arrays = as_arrays(told)
    arrays["csi"] = arrays["csi"] + extra(told.tx[0], told.rx)[:, None, None] * WAVELENGTH / (4 * np.pi)
    return told, from_arrays(arrays), fold


def _edge(tx, rx):
    frequency = torch.full((len(rx),), 2.4e9, dtype=torch.float64)
    wave = edge_wave(torch.from_numpy(rx), EDGE, UP, torch.from_numpy(tx), frequency)
    return 0.5 * wave[:, 0].numpy()


def _scattered(tx, rx):
    """Both legs, 1 / (d1 d2)."""
    before = np.linalg.norm(SCATTERERS - tx, axis=1)
    after = np.linalg.norm(rx[:, None] - SCATTERERS[None], axis=-1)
    return 0.5 * (np.exp(-2j * np.pi * (before + after) / WAVELENGTH) / before / after).sum(1)


def _fit(data, fold, tmp_path, **more):
    method = ImageSourceGP(**QUICK, **more)
    report = method.fit(data, fold, FitContext(tmp_path))
    batch = data.batch(fold.test)
    error = nmse(method.predict(batch.tx, batch.rx).mean.numpy(), batch.target.numpy())
    return method, report, error


def test_a_diffracted_wave_takes_the_shortest_way_and_spreads_as_keller_says():
    tx, rx = torch.tensor([0.3, -1.0, 0.4]).double(), torch.tensor([[3.0, 2.0, 1.7]]).double()
    along = torch.linspace(-3, 3, 200_001, dtype=torch.float64)
    points = EDGE + along[:, None] * UP
    before, after = (points - tx).norm(dim=1), (points - rx).norm(dim=1)
    best = int((before + after).argmin())
    s1, s2 = float(before[best]), float(after[best])
    wave = edge_wave(rx, EDGE, UP, tx, torch.tensor([2.4e9]).double())[0, 0]
    assert float(wave.abs()) == pytest.approx((s1 * s2 * (s1 + s2)) ** -0.5, rel=1e-3)
    turn = np.exp(-2j * np.pi * 2.4e9 / LIGHT * (s1 + s2))
    assert abs(complex(wave / wave.abs()) - turn) < 1e-2
    length, met = diffracted(rx, Edges(EDGE, UP, torch.ones(1, 1, dtype=torch.complex64)), tx)
    assert float(length) == pytest.approx(s1 + s2, rel=1e-6)
    assert torch.allclose(met[0, 0], points[best], atol=1e-3)


@pytest.mark.slow
def test_an_edge_is_found_where_it_is_and_explains_what_no_point_can(tmp_path):
    _, data, fold = _room(_edge)
    method, report, error = _fit(data, fold, tmp_path)
    blind, _, without = _fit(data, fold, tmp_path, edges=False)
    assert len(method.edges) == 1 and len(blind.edges) == 0
    found = method.edges.point[0] + method.frame.middle + torch.from_numpy(data.site.origin)
    assert float((found - EDGE[0])[:2].norm()) < 0.1 * WAVELENGTH
    assert error < 0.01 < 0.05 < without
    assert "1 edges" in " ".join(report.notes)
    state = method.state()
    again = ImageSourceGP()
    again.restore(data.site, state)
    batch = data.batch(fold.test[:4])
    torch.testing.assert_close(
        again.predict(batch.tx, batch.rx).mean, method.predict(batch.tx, batch.rx).mean
    )


def test_without_an_edge_none_is_invented(tmp_path):
    _, data, fold = _room()
    method, report, error = _fit(data, fold, tmp_path)
    assert len(method.edges) == 0 and error < 0.01
    assert "0 scatterers, 0 edges" in " ".join(report.notes)


@pytest.mark.slow
def test_scatterers_are_found_and_told_from_images(tmp_path):
    told, data, fold = _room(_scattered)
    method, _, error = _fit(data, fold, tmp_path)
    scene = method.members[0].scene
    places = (scene.sources + method.frame.middle).numpy() + data.site.origin
    named = kinds(scene.sources, box_of(method.members[0].rows, scene.transmitter))
    inside = places[[k is SourceKind.SCATTERER for k in named]]
    nearest = np.linalg.norm(SCATTERERS[:, None] - inside[None], axis=-1).min(1)
    assert (nearest < 0.1 * WAVELENGTH).all() and error < 0.01
    images = told.images.of(told.tx[0])[told.images.order == 1]
    outside = places[[k is SourceKind.IMAGE for k in named]]
    assert (np.linalg.norm(images[:, None] - outside[None], axis=-1).min(1) < 0.3 * WAVELENGTH).all()


def test_no_edges_add_nothing():
    places = torch.rand(4, 3).double()
    none = Edges.none()
    tones = torch.tensor([2.4e9, 2.5e9]).double()
    assert torch.equal(none.over_band(places, tones, places[0]), torch.zeros(4, 1, 2, dtype=torch.complex64))
    assert len(replace(none)) == 0
