"""Sums of sources as a compiled form."""

from __future__ import annotations

import numpy as np
import torch

from gsparc.apps.export.compiled.blob import Form
from gsparc.data.schema import Site
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.query import EnsembleMeans
from gsparc.models.image_sources.rows import antenna_positions, static_array
from gsparc.physics.waves import is_comb

# 16 float32 are the widest register; narrower ones take the same rows in two or four steps.
LANES = 16
# Rows that fill the last register: far away and of weight 0, so that they add nothing.
BEYOND = 1e6  # [m], a place that is near none


def compile_sources(method: ImageSourceGP, site: Site, query: EnsembleMeans) -> Form:
    """Return the form of an ensemble's sources without clutter, whose gains `query` has."""
    rotation = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    count, rows = len(query.sources), len(query.places)
    outputs, wide = query.level.shape[2] // 2, -(-rows // LANES) * LANES
    weight = torch.repeat_interleave(method.weights, torch.tensor(query.counts))[:, None, None]
    array, moving = static_array(site, method.frame.antennas), np.zeros((1, 3))
    # The pose of a receiver turns its array with it;
    # a transmitter's array stands in the site's frame.
    if site.moving_end == "rx":
        turned = torch.from_numpy(np.asarray(rotation, np.float32)).double()[None]
        moving = antenna_positions(site, torch.zeros(1, 3).double(), turned, method.frame.antennas)[
            0
        ].numpy()
    images = query.sources[None]
    if array is not None:
        images = images + torch.einsum("kij,ej->eki", query.orientations, torch.from_numpy(array))

    def padded(value: torch.Tensor, beyond: float = 0.0) -> np.ndarray:
        return torch.nn.functional.pad(value.float(), (0, wide - rows), value=beyond).numpy()

    tones = torch.from_numpy(site.tones())
    step = float(tones.diff().mean()) if len(tones) > 1 else 0.0
    # Two tones are evenly spaced whatever they are.
    even = len(tones) < 3 or is_comb(tones)
    # A comb of even tones costs one complex product per tone; uneven ones a sine each.
    combs = [(tones[0], step, len(tones))] if even else [(tone, 0.0, 1) for tone in tones]
    factors = (method.frame.scale * site.target_scale / method.factors).numpy().astype(np.complex64)
    arrays = {
        "middle": method.frame.middle.double().numpy(),
        "moving": moving.astype(np.float64),
        "sources": query.sources.double().numpy(),
        "images": images.double().numpy(),
        "offsets": np.zeros(0) if array is None else array.astype(np.float64),
        "combs": np.array(combs, np.float64),
        "by_angle": query.by_angle.flatten().float().numpy(),
        "by_length": query.by_length.flatten().float().numpy(),
        "places": padded(query.places.T, BEYOND),
        "towards": padded(query.towards),
        "level": (query.level * weight)[:, 0].numpy(),
        "weights": padded((query.weights * weight).mT),
        "factors": factors.view(np.float32),
    }
    still_ends = 1 if array is None else len(array)
    numbers = [count, rows, outputs, len(moving), still_ends, len(combs), method.frame.carrier_hz]
    return Form(3, [float(number) for number in numbers], arrays)
