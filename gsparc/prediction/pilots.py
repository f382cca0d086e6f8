"""Channels that a `Predictor` hears after its fit, as pilots of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Site
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.pilots import HeardField
from gsparc.models.method import Method
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.per_station import PerStation
from gsparc.models.station_views import OneStationView
from gsparc.prediction.query import Asked


class PilotsMixin(Asked):
    """What a `Predictor` of channels learns after its fit, at settings as they are."""

    _view: Callable[[Method, Method | None, Site, str | None], Any]

    def hear(self, tx: Any = None, rx: Any = None, *, csi: Any) -> Self:
        """Return the same model told of channels of one run, whose amplitude and phase it finds.

        Its answers are in the phase and level of that run. The last 200 rows of a station count,
        those of runs before too, each turned by its own factor; the fit and its parameters stay.

        >>> predictor.hear(rx=[2.0, 1.0, 1.5], csi=[1j])
        Traceback (most recent call last):
            ...
        ValueError: hear: this model predicts rssi; update() takes powers

        Args:
            tx, rx: places (B, 3) [m, world], as in `csi`.
            csi: (B, A, K) complex in physical units, as `csi` answers, (B, T, A, K) of several
                stations; NaN where nothing was heard.

        Raises:
            ValueError: no channels, of another shape, or a model whose waves cannot be told more.
        """
        if self.site.kind != "csi":
            raise ValueError(f"hear: this model predicts {self.site.kind}; update() takes powers")
        self.site.need_phase("hear")  # rows of a run share one factor
        placed, known = self.queries.query(tx, rx), self.site.measured
        one = self.method.predict(placed.query.rows(slice(1))).mean.shape[1:]
        shape = one if known is None else known.shape
        count = len(placed.query) // (1 if placed.asked is None else len(placed.asked))
        ends = () if placed.asked is None else (len(placed.stations),)
        values = torch.as_tensor(np.asarray(csi)) / self.site.target_scale
        if values.numel() != math.prod((count, *ends, *shape)):
            text = ", ".join(map(str, (count, *ends, *shape)))
            raise ValueError(f"hear: csi is of shape {tuple(values.shape)}, expected ({text})")
        values = values.reshape(count, *ends, *shape)
        values = values if placed.asked is None else values[:, placed.asked]
        values = values if known is None else values[..., torch.from_numpy(known)]
        values = values.reshape(-1, *one)
        view: Self = self._view(
            condition_on_pilots(self.method, placed.query, values), None, self.site, None
        )
        return view


def condition_on_pilots(method: Method, query: Query, values: Tensor, doubt: float = 1.0) -> Method:
    """Return a fitted method that was told of channels (n, A, K), stored units, of one run.

    `doubt` is what its variances are multiplied by, see `Mixture`.

    Raises:
        ValueError: it is not made of waves that pilots can be added to.
    """
    if isinstance(method, OneStationView):
        return OneStationView(
            condition_on_pilots(method.inner, method.of_station(query), values), method.number
        )
    if isinstance(method, PerStation) and (shared := method.shared_copy) is not None:
        return method.with_shared_copy(condition_on_pilots(shared, query, values))
    if isinstance(method, Mixture) and method.member is not None:
        return condition_on_pilots(method.member, query, values, method.doubt)
    if isinstance(method, HeardField):
        return HeardField(method.field, query, values, method, method.doubt)
    if isinstance(method, ChannelField):
        return HeardField(method, query, values, doubt=doubt)
    raise ValueError(f"hear: {method.name} takes no pilots after its fit; model=channels does")
