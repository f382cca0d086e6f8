"""Reductions of the array model: fewer packets, fewer pixels."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsparc.array.wave_packets import WavePackets
from gsparc.methods.coarse_grid import Filled, coarser
from gsparc.methods.method import Method
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import MeanOnly
from gsparc.physics.bartlett import SpectrumRenderer

if TYPE_CHECKING:
    from gsparc.array.method import ArrayField

RIDGE = 1e-6  # relative to a feature's mean square, as in `distil`


@torch.no_grad()
def reduced(method: ArrayField, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """The array field with fewer packets (`keep`, a share) on fewer pixels (`stride`)."""
    assert method.field is not None and method.site is not None and method.background is not None
    twin = copy.copy(method)
    if "keep" in settings:
        twin.field = _fewer(method.field, float(settings["keep"]), measured)
    site, stride = method.site, int(settings.get("stride", 1))
    found: Method = twin
    if stride > 1:
        array, grid, wavelength = site.array_geometry()
        background = method.background[::stride, ::stride]
        twin.renderer = SpectrumRenderer(array, coarser(grid, stride), wavelength, background)
        found = Filled(twin, grid, stride)
    return found if settings.get("confidence", True) else MeanOnly(found)


def _fewer(field: WavePackets, share: float, measured: dict[str, Tensor]) -> WavePackets:
    """The packets that contribute most, their gains fitted to the full model around the samples."""
    total = len(measured["contribution"])
    count = max(1, math.ceil(share * total))
    kept = measured["contribution"].topk(count).indices.sort().values
    blank = (torch.zeros(count, 3), torch.ones(count), torch.zeros(count, 3), field.origin)
    few = WavePackets(*blank, elements=field.elements).requires_grad_(False)
    both = torch.cat([kept, kept + total])
    few.form.copy_(field.form[:, both])
    places = measured["places"]
    widths = field.form[3, :total].neg().mul(2).rsqrt()  # of the window exp(-x^2 / 2 s^2)
    draws = torch.Generator().manual_seed(0)
    spread = widths.median() * torch.randn(8, *places.shape, generator=draws)
    queries = torch.cat([places, (places + spread / 2).flatten(0, 1)])
    features = few.features(queries).double()
    wanted = (field.features(queries) @ field.gains).double()
    gram = features.mT @ features
    gram.diagonal().add_(RIDGE * gram.diagonal().mean())
    few.gains.copy_(torch.linalg.solve(gram, features.mT @ wanted).float())
    few.bias.copy_(field.bias)
    return few
