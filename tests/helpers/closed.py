"""Closed forms fitted to rows, and read back, for tests."""

import io
from typing import TypeVar

import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.closed_form import ClosedForm, method_from_state, method_state
from gsparc.training.context import FitContext

Form = TypeVar("Form", bound=ClosedForm)


def fitted_to(method: Form, data: Measurements, rows: np.ndarray) -> tuple[Form, tuple[str, ...]]:
    """The method fitted to rows (n,), and its notes."""
    return method, method.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext()).notes


def conditioned(prior: ChannelPrior, data: Measurements, rows: np.ndarray) -> ChannelField:
    """Waves of known terms, given rows (n,)."""
    field = ChannelField()
    field.site, field.prior, field.channel = data.site, prior, tuple(data.target.shape[1:])
    field.condition(data, rows)
    return field


def read_back(method: Form) -> Form:
    """What is read from a file of its stored state."""
    file = io.BytesIO()
    torch.save(method_state(method), file)
    file.seek(0)
    assert method.site is not None
    return method_from_state(method.site, torch.load(file, weights_only=True))
