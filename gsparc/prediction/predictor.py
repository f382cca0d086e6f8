"""`gsparc.load(FILE)`: ask a trained model about places, in world coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from torch import Tensor

from gsparc.base.errors import DataError
from gsparc.data.query import Query
from gsparc.data.schema import Site
from gsparc.data.station_names import find_station
from gsparc.data.target import Kind
from gsparc.data.units import PowerUnit
from gsparc.models.abilities import AddsCarriers, HasGaussians
from gsparc.models.device_offsets import find_device
from gsparc.models.method import MEAN_DEVICE, Method, Prediction
from gsparc.models.per_station import PerStation
from gsparc.models.predicting import predict_with_threads
from gsparc.models.station_sites import station_site
from gsparc.models.station_views import AnywhereView
from gsparc.physics.row_factors import describe_factor
from gsparc.prediction.confidence import ConfidenceMixin, Trusted
from gsparc.prediction.gradients import predict_with_gradients
from gsparc.prediction.jointly import JointMixin
from gsparc.prediction.pilots import PilotsMixin
from gsparc.prediction.query import DegreesMixin, PlacedQuery, Queries, read_place
from gsparc.prediction.timing import Call
from gsparc.prediction.updating import UpdateMixin, read_versions

if TYPE_CHECKING:
    from gsparc.data.site_objects import GaussianCloud
    from gsparc.prediction.channels import Paths
    from gsparc.prediction.stored_point import Operating


class Predictor(DegreesMixin, JointMixin, ConfidenceMixin, UpdateMixin, PilotsMixin):
    """A fitted method in world coordinates.

    Positions are (3,) or (B, 3) [m]; a single position gives a result without the leading axis.
    NumPy (or lists) in gives NumPy out, torch in gives torch out. The static end may be left out:
    the model knows where it stood.

    Powers and their deviations come back in the unit that they were given in (`unit`), or in the
    one that `unit=` names: dBm, dBW, W, mW, ...,
    or `linear` where nobody said what decibels refer to.

    With `grad=True` predictions are differentiable by the position of what moves, which is then a
    tensor: autograd follows them in reverse mode. All is computed in float64 and answered in the
    precision of the positions; `ValueError` where the model has no gradients, under `torch.func`
    and in forward mode.
    Which rows are nearest and what a clamp cuts off have none.

    >>> at = torch.tensor([2.0, 1.0, 1.5], dtype=torch.float64, requires_grad=True)
    >>> predictor.rssi(rx=at, grad=True).sum().backward()
    >>> at.grad.shape
    torch.Size([3])

    Args:
        method: fitted or restored.
        site: the dataset's fixed facts: `kind`, the `box` of places [m, local] and its `origin`,
            `stations`.
        whole: asked for the confidence, where `method` spares it; None asks `method`.
        point: the operating point `method` answers at, if one was chosen (`load(budget_ms=...)`),
            else None.
        extra: what else the checkpoint holds, such as the split's hash.
        trusted: which confidence is answered, and from when on a prediction is accepted
            (`gsparc calibrate`).
        kind: of the confidence, as in `load`; None: as `trusted` says.
        unit: of powers; None: that of the measurements. The attribute is "1" of channels and
            spectra.

    Raises:
        ValueError: no unit that these measurements can be turned into.
    """

    def __init__(
        self,
        method: Method,
        site: Site,
        whole: Method | None = None,
        point: Operating | None = None,
        trusted: Trusted | None = None,
        kind: str | None = None,
        extra: Mapping[str, Any] | None = None,
        unit: str | None = None,
    ) -> None:
        self.extra = extra or {}
        self.trusted, self.kind = trusted or Trusted(), kind
        self.method, self.site, self.point = method, site, point
        # A reduced method answers means alone: what states variance
        # or confidence asks the whole one.
        self._whole = whole or method
        self.versions = read_versions(self.extra)
        self.queries = Queries(site, None, _answered(method, site))
        self._unit = unit
        self.unit = self._answer_unit(None).name  # "1" of channels and spectra
        self._device = MEAN_DEVICE
        # Of the whole model, and which of its stations is asked:
        # later rows are of it in every view.
        self._model_site, self._own_station = site, None

    def __repr__(self) -> str:
        # Boxes are in local coordinates, users read the world's.
        low, high = (self.site.box + self.site.origin).round(2).tolist()
        return (
            f"Predictor({self.method.name} of {self.site.kind} on {self.site.name}; "
            f"the {self.site.moving_end} moves, scene from {low} to {high} m)"
        )

    @property
    def known(self) -> str:
        """Say in words what answers are known up to: `all`,
        or `up to a phase of each row` of channels.
        """
        free = self.site.unknown_factor
        return "all" if free == "none" else f"up to {describe_factor(free)} of each row"

    @property
    def stations(self) -> list[str]:
        """Names (T,) of stations, in the order of the columns of `rssi`;
        empty where there are none.

        >>> gsparc.load("city.ckpt").stations
        ['roof-2', 'roof-3']
        """
        return [name for name in self.site.every_station.shown if name]

    def select_station(self, station: str | int | None) -> Predictor:
        """Return the same model asked about one station alone, by a name of `stations` or number;
        None: all.

        >>> gsparc.load("city.ckpt").select_station("roof-3").rssi(rx=[2.0, 1.0, 1.5]).shape
        (1,)

        Raises:
            ValueError: no station is called that.
        """
        if station is None:
            return self
        stations = self.site.stations
        if stations is None:
            raise ValueError(
                f"select_station: {self.site.name} has one static end, and no stations"
            )
        number = find_station(station, stations)
        if number is None:
            raise ValueError(
                f"select_station: no station {station!r}; there are {', '.join(stations.shown)}"
            )
        return self.ask_station(number)

    def ask_station(self, number: int) -> Predictor:
        """Return the same model asked about a station by its number;
        itself where the one has no name.

        Raises:
            ValueError: it had too few training rows.
        """
        if self.site.stations is None:
            return self
        # By number: two stations at one place, with different carriers, cannot be told apart by it.
        both = self.method, self._whole
        method, whole = (None if m is None else m.station_method(number) for m in both)
        view = self._view(method, whole, station_site(self.site, number), self._unit)
        view.queries = Queries(view.site, None if isinstance(self.method, PerStation) else number)
        view._own_station = number
        return view

    def stand_at(self, place: Any) -> Predictor:
        """Return the same model asked about an end that stands anywhere, where it was at several.

        Args:
            place: (3,) of that end, world [m].

        Raises:
            DataError: it stood at one place, or moved, when this was measured.
        """
        if self.site.stations is None:
            raise DataError("other_end: there is one place, or the query says it; leave it out")
        still = read_place("other_end", place)
        words = ", ".join(f"{coordinate:g}" for coordinate in still)
        site = replace(
            self.site,
            name=f"{self.site.name} from ({words})",
            stations=None,
            static_position=still - self.site.origin,
            sha256=sha256(f"{self.site.sha256} {words}".encode()).hexdigest(),
        )
        view = self._view(AnywhereView(self.method), None, site, self._unit)
        view.queries, view.extra = Queries(site), {}  # what was tested is of stations
        return view

    def select_carrier(self, frequency_hz: float) -> Predictor:
        """Return the same model asked about one carrier [Hz],
        also one that nobody measured if it can.

        >>> predictor.select_carrier(28e9)  # of a model of one carrier
        Traceback (most recent call last):
            ...
        ValueError: frequency_hz=2.8e+10: arrays has one carrier alone

        Raises:
            ValueError: the model knows one carrier, or its own carriers alone.
        """
        carriers = self.site.every_station.carrier_hz
        if carriers is None:
            raise ValueError(
                f"frequency_hz={frequency_hz:g}: {self.site.name} has one carrier alone"
            )
        if not (np.isfinite(frequency_hz) and frequency_hz > 0):
            raise ValueError(f"frequency_hz={frequency_hz}: expected a frequency above 0 [Hz]")
        if len(matches := np.flatnonzero(np.isclose(carriers, frequency_hz, rtol=1e-6))) == 1:
            return self.ask_station(int(matches[0]))
        both = self.method, self._whole
        if not all(isinstance(answerer, AddsCarriers) for answerer in both):
            raise ValueError(
                f"frequency_hz={frequency_hz:g}: {self.method.name} has no other carriers"
            )
        method, whole = (cast(AddsCarriers, method).add_carrier(frequency_hz) for method in both)
        return self._view(method, whole, method.fitted_site, self._unit).ask_station(len(carriers))

    def _view(
        self, method: Method, whole: Method | None, site: Site, unit: str | None
    ) -> Predictor:
        """A copy that goes on from here apart: whatever is not given stays, later rows too."""
        view = copy(self)
        view.method, view._whole, view.site, view._unit = method, whole or method, site, unit
        view.unit = view._answer_unit(None).name
        view.queries = Queries(site, self.queries.station, _answered(method, site))
        view._prepared = []
        return view

    def select_device(self, device: str) -> Predictor:
        """Return the same model answering as one of the devices that measured would read.

        Without it powers are those of the mean device, and the devices' variance is in theirs.

        Raises:
            ValueError: no device is called that.
        """
        view = self._view(self.method, self._whole, self.site, self._unit)
        view._device = find_device(device, self.site)
        return view

    def in_levels(self, unit: str | None) -> Predictor:
        """Return the same model whose powers and maps are levels in `unit`, dBm or dBW; None:
        as measured.

        Raises:
            ValueError: decibels of a reference that nobody knows.
        """
        return self._view(self.method, self._whole, self.site.in_levels(unit), None)

    def _answer_unit(self, unit: str | None) -> PowerUnit:
        """The unit that answers are wanted in."""
        if self.site.target.is_level:
            return self.site.power_unit(unit or self._unit)
        if unit or self._unit:
            raise ValueError(
                f"unit={unit or self._unit}: goes with powers, not with {self.site.kind}"
            )
        # Other kinds have no unit of powers: physical values are stored ones times the scale.
        return PowerUnit("1", False, self.site.target_scale)

    def predict(
        self, tx: Any = None, rx: Any = None, *, unit: str | None = None, grad: bool = False
    ) -> Prediction:
        """Return mean (B, ...), variance and confidence (B,) at once, as tensors,
        in the measurements' unit; of several stations, if neither end says which, (B, T, ...) and
        (B, T).

        The variance is the expected squared error of an entry, None where the method states none.
        The confidence is None where the method has none; else the one that `confidence` answers.
        With `grad` it is the method's own, and None where `confidence` answers another.

        >>> said = predictor.predict(rx=[[2.0, 1.0, 1.5], [3.0, 1.0, 1.5]])
        >>> said.mean.shape, bool((said.variance > 0).all())  # dBm, and dBm^2 of a measurement
        (torch.Size([2, 1]), True)

        Raises:
            ValueError: `grad` of a model without gradients, or of positions that are no tensors.
        """
        if grad:
            placed, said = self._moments(self._whole, tx, rx, unit, grad)
            return said.map(placed.by_station)
        wanted, placed = self._answer_unit(unit), self.queries.query(tx, rx)
        stored = predict_with_threads(self._whole, placed.query)
        sure = self._method_confidence(stored)
        said = self._in_unit(stored, wanted, placed.query)
        return replace(said, unknown=None if sure is None else 1 - sure).map(placed.by_station)

    def std(self, tx: Any = None, rx: Any = None, *, unit: str | None = None) -> Any:
        """Return the expected root mean square error of an entry,
        in the unit of the answers and float32.

        Far from all data it is that of knowing nothing: about 1 of spectra, whose pixels are from 0
        to 1. Its shape goes with theirs: (B, 1) of powers, (B, T) of several stations, (B, 1, 1)
        of other kinds, (B, T, 1, 1) of several stations.

        >>> predictor.std(rx=[[2.0, 1.0, 1.5], [900.0, 1.0, 1.5]]).shape  # [dB]
        (2, 1)

        Raises:
            ValueError: the method knows none, or as in `rssi`.
        """
        placed, said = self._moments(self._whole, tx, rx, unit)
        if (spread := said.deviation) is None:
            raise ValueError(f"{self.method.name} states no deviations")
        return placed.match(placed.by_station(spread))

    def cycle_places(self, places: np.ndarray) -> Call:
        """Return a function for a clock, which asks about one of the places each time it is called.

        Places are (n, 3), of both ends (n, 6) [m], local: less `site.origin`. Of several stations
        the first that the model answers for is asked.
        """
        predictor = self.ask_station(next(iter(self.queries.answered.tolist()), 0))

        def ask(number: int) -> Any:
            ends = self.site.world_ends(places[number % len(places)])
            placed, mean = predictor._mean(self.site.kind, ends.get("tx"), ends.get("rx"))
            return placed.match(mean)

        return ask

    def spectrum(
        self,
        tx: Any = None,
        rx: Any = None,
        *,
        frequency_hz: float | None = None,
        grad: bool = False,
    ) -> Any:
        """Return amplitudes by direction at the receiver, (B, H, W) float32 in [0, 1],
        as they were measured; (B, T, H, W) of several stations.

        Their square is the power; 1 is the largest of all stored ones or
        of its own image, as the file was scaled. Row i is an elevation of the receiver, column j an
        azimuth: i x 90/H and j x 360/W degrees unless the file gives `grid_deg`. (H, W)
        of a single place.

        Args:
            tx, rx: positions [m, world]; `rx` may be a world `Pose`, of a receiver that is turned.
            frequency_hz: carrier, of a model of several; see `select_carrier`.
            grad: as in `predict`.

        >>> predictor.spectrum(rx=[2.0, 1.0, 1.5])  # of a model of powers
        Traceback (most recent call last):
            ...
        ValueError: this model predicts rssi (dataset arrays), not spectrum: call .rssi(...)

        Raises:
            ValueError: the model predicts something else, a position is missing or not finite, or
                `grad` as in `predict`.
        """
        predictor = self if frequency_hz is None else self.select_carrier(frequency_hz)
        placed, mean = predictor._mean("spectrum", tx, rx, grad)
        return placed.match(mean)

    def csi(
        self,
        tx: Any = None,
        rx: Any = None,
        *,
        uplink: Any = None,
        frequency_hz: Any = None,
        symbols: int | None = None,
        grad: bool = False,
    ) -> Any:
        """Return the channel (B, antennas, subcarriers) complex64,
        in the physical units of the measurements; of several stations, if neither end says which,
        (B, T, antennas, subcarriers).

        All three axes are there for one antenna or tone, too: of measured channels (B, K) take
        `[:, 0]`. What was constant in all rows, as null tones are, is NaN. Where channels are made
        of `paths`, these sum to them with the factor `reference_hz / f`, see `Paths.channel`.

        >>> heard, tones = np.exp(1j * places[:, :1] * [1, 2]), [2.4e9, 2.41e9]  # (60, 2)
        >>> known = {"tx": [9.0, 9.0, 2.6], "csi": heard, "frequency_hz": tones}
        >>> near = gsparc.fit(rx=places, **known, model="nearest")
        >>> near.csi(rx=places).shape, (near.csi(rx=places)[:, 0] - heard).shape
        ((60, 1, 2), (60, 2))

        Args:
            tx, rx: positions; where the model reads a fresh uplink, none.
            uplink: (B, U, L) or (U, L) complex channels heard now, for a model that reads them.
            frequency_hz: (K,) [Hz] of any OFDM grid within the band; None for the measured tones.
            symbols: OFDM symbols of a slot; then the result is Sionna's
                [batch, rx, rx_ant, tx, tx_ant, symbols, K]: places on `batch`, stations on the end
                that stands, antennas on the receiver where the measurements name an array.
            grad: as in `predict`; at the measured tones alone.
        """
        if uplink is None and frequency_hz is None and symbols is None:
            placed, mean = self._mean("csi", tx, rx, grad)
            return placed.match(self.site.in_shape_of_file(mean))
        if grad:
            raise ValueError(
                "grad=True: channels have gradients at positions and the measured tones alone"
            )
        from gsparc.prediction import channels

        if uplink is not None:
            channel = channels.uplink_channels(self.method, self.site, uplink, frequency_hz)
            answer = channels.to_resource_grid(channel, self.site, None, symbols)
            return answer if isinstance(uplink, Tensor) else answer.numpy()
        placed, mean = self._mean("csi", tx, rx)
        answer = channels.to_resource_grid(mean, self.site, frequency_hz, symbols)
        return answer if placed.as_torch else answer.numpy()

    def paths(self, uplink: Any = None, *, tx: Any = None, rx: Any = None) -> Paths:
        """Return gains, delays [s], directions: of what an uplink (B, U, L)
        holds or of a field at positions.

        See `gsparc.prediction.channels.Paths` for shapes:
        gains complex64 in the unit of the channels.

        Raises:
            ValueError: the model's channels are not made of paths.
        """
        from gsparc.prediction import channels

        if uplink is not None:
            return channels.uplink_paths(self.method, self.site, uplink)
        return channels.paths_at(self._whole, self.site, self.queries.query(tx, rx).of_one())

    def gaussians(self, tx: Any = None, rx: Any = None) -> GaussianCloud:
        """Return the N Gaussians that are rendered, with what they emit for these positions.

        Means (N, 3) and standard deviations (N, 3) [m, world], quaternions, opacities (N,) in [0,
        1] and strengths (N,) in the unit that `label` says; see
        `gsparc.data.site_objects.GaussianCloud`.

        Raises:
            ValueError: what answers is not rendered of Gaussians.
        """
        if not isinstance(self.method, HasGaussians):
            raise ValueError(f"gaussians: {self.method.name} renders none")
        cloud = self.method.gaussians(self.queries.query(tx, rx).of_one())
        return replace(cloud, means=cloud.means + self.site.origin)

    def rssi(
        self, tx: Any = None, rx: Any = None, *, unit: str | None = None, grad: bool = False
    ) -> Any:
        """Return powers (B, 1) float32 in the unit of the measurements (`Predictor.unit`),
        or in another.

        Of several stations, if neither end says which, of all (B, T), as they were measured:
        columns in the order of `Predictor.stations`, NaN of those that had too few training rows. A
        level is -inf where no power is predicted.

        >>> gsparc.load("model.ckpt").rssi(rx=[2.0, 1.0, 1.5], unit="mW").shape
        (1,)

        >>> predictor.rssi(rx=torch.tensor([[2.0, 1.0, 1.5]])).dtype  # torch in, torch out
        torch.float32
        >>> gsparc.load("city.ckpt").rssi(rx=[[2.0, 1.0, 1.5]]).shape  # of both stations
        (1, 2)

        Raises:
            ValueError: no unit that these powers can be turned into, or as in `spectrum`.
        """
        placed, mean = self._mean("rssi", tx, rx, grad, unit)
        return placed.match(mean)

    def _mean(
        self, kind: Kind, tx: Any, rx: Any, grad: bool = False, unit: str | None = None
    ) -> tuple[PlacedQuery, Tensor]:
        """Answers (B, ...), (B, T, ...) of several stations, in the precision of the method."""
        if self.site.kind != kind:
            raise ValueError(
                f"this model predicts {self.site.kind} (dataset {self.site.name}), not {kind}: "
                f"call .{self.site.kind}(...)"
            )
        placed, said = self._moments(self.method, tx, rx, unit, grad)
        mean = said.mean if grad or said.mean.is_complex() else said.mean.float()
        return placed, placed.by_station(mean)

    def _moments(
        self, method: Method, tx: Any, rx: Any, unit: str | None, grad: bool = False
    ) -> tuple[PlacedQuery, Prediction]:
        """Answers of every row that is asked, which autograd follows if wanted, in a unit."""
        wanted = self._answer_unit(unit)
        if not grad:
            placed = self.queries.query(tx, rx)
            stored = predict_with_threads(method, placed.query)
            return placed, self._in_unit(stored, wanted, placed.query)
        stored, dtype, placed = predict_with_gradients(method, self.queries, tx, rx)
        result = self._in_unit(stored, wanted, placed.query)
        is_own = (self.kind or self.trusted.kind) in (None, "learned")
        mean = result.mean.to(dtype.to_complex() if result.mean.is_complex() else dtype)
        unknown = None if result.unknown is None or not is_own else result.unknown.to(dtype)
        return placed._replace(as_torch=True), Prediction(mean, result.variance, unknown)

    def _in_unit(self, stored: Prediction, unit: PowerUnit, query: Query) -> Prediction:
        """Of stored targets, as the chosen device reads them, in a unit."""
        stored = stored.of_devices(self.site, self._device, query.station)
        # In decibels a variance depends on the mean too.
        variance = None if stored.variance is None else unit.variance(stored.mean, stored.variance)
        explained = (
            None
            if stored.explained is None
            else unit.values(stored.explained).to(stored.mean.dtype)
        )
        mean = unit.values(stored.mean)  # in float64, as levels of -100 dB in float32 lose 1e-5 dB
        return Prediction(mean, variance, stored.unknown, explained)


def _answered(method: Method, site: Site) -> list[int]:
    """Numbers of the stations that had training rows enough; none where there is one end."""

    def has_answer(number: int) -> bool:
        with suppress(ValueError):
            method.station_method(number)
            return True
        return False

    return [] if site.stations is None else [*filter(has_answer, range(len(site.stations)))]
