"""Facts of a dataset and its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from gsparc.data.blocks import take
from gsparc.data.query import Batch
from gsparc.data.target import TARGETS, Kind, Target
from gsparc.data.units import PowerUnit
from gsparc.ops import Pose, SphereGrid
from gsparc.physics.row_factors import UnknownFactor, describe_factor

if TYPE_CHECKING:
    from gsparc.data.georeference import Georeference

Places = TypeVar("Places")
Channels = TypeVar("Channels", np.ndarray, Tensor)

# Channels with unknown factors are compared after alignment, which is another figure.
Scored = Literal[Kind, "aligned csi"]  # by which figures of merit
End = Literal["rx", "tx"]
Chosen = np.ndarray | slice  # of rows
ENDS_OF_PLACES: tuple[End, ...] = ("tx", "rx")  # in the order of six columns
ENDS: dict[str, str] = {"rx": "receiver", "tx": "transmitter"}  # in words
OTHER: dict[str, End] = {"rx": "tx", "tx": "rx"}
LIGHT = 299_792_458.0  # [m/s]
OF_STATION = ", station "  # before its name, in that of a site as one of several stations sees it
ALONE = ("",)  # names of the one static end of a site without stations
TrainTest = tuple[np.ndarray, np.ndarray]  # rows (n,) to train and to test on


def show_names(names: Sequence[str], labels: Sequence[str] | None) -> tuple[str, ...]:
    """Return names (T,) of stations as people read them,
    `W03-2 (150)` of one that a list of cells labels.
    """
    pairs = zip(names if labels is None else labels, names, strict=True)
    return tuple(name if label == name else f"{label} ({name})" for label, name in pairs)


@dataclass(frozen=True)
class Stations:
    """Static ends of which there are several; one place at two carriers is two stations.

    Attributes:
        position: (T, 3) float64 [m], *local*.
        name: (T,) what a user calls them.
        rotation: (T, 3, 3) float64, local to world; None where receivers are not turned, or
            transmit.
        carrier_hz: (T,) [Hz]; None where all have the site's.
        sector: (T, 6) azimuth from north, tilt below the horizon, widths of the beam across and in
            height [deg], and power [dB], NaN where unknown; None where nothing of it is known.
        label: (T,) what a list of cells calls them, to be shown; None where that is `name`. It is
            no fact of the measurements.
        array: (T, M, 3) [m] receive elements where each carrier has an array of its own; None: the
            site's.
    """

    position: np.ndarray
    name: tuple[str, ...]
    rotation: np.ndarray | None = None
    carrier_hz: np.ndarray | None = None
    sector: np.ndarray | None = None
    label: Sequence[str] | None = field(default=None, compare=False)
    array: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.position)

    @property
    def shown(self) -> tuple[str, ...]:
        """(T,) label and name, or the name where that is all, for people."""
        return show_names(self.name, self.label)

    @property
    def named(self) -> dict[str, Sequence[str]]:
        """(T,) names as columns of tables have them: `station`, and `cell` of a list of cells."""
        if self.name == ALONE:
            return {}
        return {"station": self.name} | ({} if self.label is None else {"cell": self.label})

    @property
    def beams(self) -> np.ndarray:
        """`sector` (T, 6), NaN where nothing of it is known."""
        return np.full((len(self), 6), np.nan) if self.sector is None else self.sector

    def subset(self, numbers: np.ndarray, names: Sequence[str] | None = None) -> Stations:
        """Return stations of these numbers (n,), which may repeat, under `names` or their own."""
        optional = (self.rotation, self.carrier_hz, self.sector, self.array)
        rotation, carrier, sector, array = (
            None if values is None else values[numbers] for values in optional
        )
        called = tuple(names or (self.name[i] for i in numbers))
        label = None if self.label is None else tuple(self.label[i] for i in numbers)
        return Stations(self.position[numbers], called, rotation, carrier, sector, label, array)

    def add_carrier(self, frequency_hz: float) -> Stations:
        """Return these and, last, that of the nearest carrier at another [Hz],
        arrays alike in wavelengths.

        >>> one = Stations(np.zeros((1, 3)), ("2.4 GHz",), carrier_hz=np.array([2.4e9]))
        >>> one.add_carrier(5e9).name
        ('2.4 GHz', '5 GHz')
        """
        assert self.carrier_hz is not None
        near = int(np.abs(np.log(self.carrier_hz / frequency_hz)).argmin())
        name = f"{frequency_hz / 1e9:.9g} GHz"
        both = self.subset(np.r_[: len(self), near], (*self.name, name))
        array = both.array
        if array is not None:
            array[-1] *= self.carrier_hz[near] / frequency_hz
        label = None if both.label is None else (*both.label[:-1], name)
        carrier = np.r_[self.carrier_hz, frequency_hz]
        return replace(both, carrier_hz=carrier, label=label, array=array)


@dataclass(frozen=True)
class StaticEnds:
    """What a file says of its links beyond the plain schema.

    Attributes:
        static_end: which end the stations, or the one static end, are; None where both move.
        stations: in world coordinates; None where there is one static end, or none.
        unknown_transmitter: powers of a transmitter whose place nobody gave.
        georeference: of the world's origin, where places came in degrees.
    """

    static_end: End | None
    stations: Stations | None = None
    unknown_transmitter: bool = False
    georeference: Georeference | None = None


@dataclass(frozen=True)
class Site:
    """The fixed facts of a measurement campaign.

    >>> box = np.array([[0.0, 0.0, 1.5], [9.0, 9.0, 1.5]])
    >>> site = Site("hall", "rssi", "tx", None, None, 2.4e9, None, np.zeros(3), box, box, sha256="")
    >>> site.moving_end, round(site.wavelength, 4), site.query_box.shape  # the receiver moves
    ('rx', 0.1249, (2, 3))

    Attributes:
        name: dataset name as it appears in every log and summary.
        kind: what a target is: `spectrum` (H, W) in [0, 1]; `csi` (antennas, subcarriers) complex;
            `rssi` (1,) linear power.
        static_end: which end never moves: `rx` (RFID) or `tx` (Sionna, NeWRF); None when both move.
        grid: directions of a spectrum; None for CSI and RSSI.
        array: (M, 3) [m] receive element positions, receiver frame; None when unknown or one
            element.
        normalisation: how the published spectrum was scaled: `max`, `minmax`, `power` or `none`.
        carrier_hz: carrier frequency [Hz]; None when unknown.
        subcarriers_hz: (K,) absolute frequencies [Hz]; None for spectra.
        origin: (3,) float64 [m], world position that local coordinates are measured from.
        box: (2, 3) float64 [m], lower and upper corner of everything measured, *local* coordinates.
        target_scale: stored target = physical target / target_scale.
        sha256: content hash of what was loaded.
        stand_in: for a simulated replacement, the name of the release it stands in for; else None.
        convergence_error: NMSE between two solver seeds for simulated data; else None.
        static_position: (3,) float64 [m], the place of the static end, *local*; None when unknown,
            when there are several, or when both ends move.
        rx_rotation: (3, 3) float64, how the first row's receiver is turned; None when unknown.
        uplink_array: (U, 3) float64 [m] antennas that receive a snapshot's uplink; None where there
            is none.
        uplink_hz: (L,) absolute frequencies of the uplink [Hz].
        antennas: (A,) rows of `uplink_array` that the target's antennas are.
        stations: the static ends where there are several; `Measurements.station` says which a row
            is of.
        georeference: where on Earth the world's origin lies; None when unknown.
        moving_box: (2, 3) float64 [m], lower and upper corner of where the moving end was, *local*;
            (2, 6) of both as in `Measurements.moving`.
        level_unit: what 10 log10 of a received power is in, `dB` where the file does not say.
        unit: that powers were given in, and are answered in; None: `level_unit`.
        unknown_factor: what nobody knows of the complex factor of each row, see
            `gsparc.physics.row_factors`.
        phase_reference: of rows that were turned to each other: `carrier`, phases over places are
            those of waves; `neighbours`, near rows were made alike. None where rows are as
            measured.
        device_names: (D,) what measured powers is called; None where nothing tells.
        device_levels: (T, D + 1, 2) at each station the offset [dB] of each to their mean, taken
            off, and variance [dB^2] of what is not known of it; the last of a device that
            nobody named. None before that.
        measured: (A, K) bool, of a file's antennas and tones those that targets hold, as all others
            are constant or marked in every row; None: all.
    """

    name: str
    kind: Kind
    static_end: Literal["rx", "tx"] | None
    grid: SphereGrid | None
    array: np.ndarray | None
    carrier_hz: float | None
    subcarriers_hz: np.ndarray | None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    box: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    moving_box: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    sha256: str = ""
    normalisation: str = "none"
    target_scale: float = 1.0
    stand_in: str | None = None
    convergence_error: float | None = None
    static_position: np.ndarray | None = None
    rx_rotation: np.ndarray | None = None
    uplink_array: np.ndarray | None = None
    uplink_hz: np.ndarray | None = None
    antennas: np.ndarray | None = None
    stations: Stations | None = None
    georeference: Georeference | None = None
    level_unit: str = "dB"
    unit: str | None = None
    unknown_factor: UnknownFactor = "none"
    phase_reference: Literal["carrier", "neighbours"] | None = None
    device_names: tuple[str, ...] | None = None
    device_levels: np.ndarray | None = field(default=None, compare=False)
    measured: np.ndarray | None = field(default=None, compare=False)

    @property
    def target(self) -> Target:
        """What a target is: facts of its kind."""
        return TARGETS[self.kind]

    @property
    def scored(self) -> Scored:
        """The figures of merit that tell of it; rows with factors
        of their own are aligned first.
        """
        # Only channels have phases: powers and spectra are the same under any factor.
        return (
            "aligned csi" if self.target.is_complex and self.unknown_factor != "none" else self.kind
        )

    def in_shape_of_file(self, channels: Channels) -> Channels:
        """Return channels (..., a, k) as a file holds them, (..., A, K),
        NaN where nothing was `measured`.
        """
        if self.measured is None:
            return channels
        known: np.ndarray = self.measured
        shape = (*channels.shape[:-2], *known.shape)
        entries = channels.reshape(*channels.shape[:-2], -1)
        if isinstance(channels, Tensor):
            whole = channels.new_full(shape, torch.nan)
            whole[..., torch.from_numpy(known)] = entries
            return whole
        filled = np.full(shape, np.nan, channels.dtype)
        filled[..., known] = entries
        return filled

    def need_phase(self, what: str) -> None:
        """Raise `ValueError` where rows have phases of their own, so that `what` cannot be told."""
        if self.unknown_factor != "none":
            raise ValueError(
                f"{what}: channels are known up to {describe_factor(self.unknown_factor)} of "
                "each row"
            )

    @property
    def moving_end(self) -> End:
        """The end whose position is the query; the receiver where both move."""
        # Both may move: the receiver is then the one that single-ended code asks about.
        return OTHER[self.still_end]

    @property
    def paired(self) -> bool:
        """Whether both ends move: a place is a pair of positions."""
        return self.static_end is None

    @property
    def still_end(self) -> End:
        """The other end: the one that stands still; the transmitter where both move."""
        return self.static_end or "tx"

    def world_ends(self, places: np.ndarray) -> dict[End, np.ndarray]:
        """Return world places (..., 3) [m] by end of local ones (..., 3) or (..., 6), see `moving`.

        >>> site = predictor.site
        >>> bool(np.allclose(site.local_places(site.world_ends(site.box)), site.box))
        True
        """
        parts = np.split(np.asarray(places, np.float64), len(self.moving_ends), axis=-1)
        return {end: part + self.origin for end, part in zip(self.moving_ends, parts, strict=True)}

    def name_moving(self, places: Places) -> dict[str, Places]:
        """Return world places (..., 3) [m] of the moving end under its name,
        as a `Predictor` takes them.

        >>> predictor.site.name_moving([1.0, 2.0, 1.5])
        {'rx': [1.0, 2.0, 1.5]}
        """
        return {self.moving_end: places}

    def local_places(self, world: Mapping[End, np.ndarray]) -> np.ndarray:
        """Return local places (n, 3) or (n, 6) [m] of world ones by end:
        what `world_ends` takes.
        """
        return np.hstack([world[end] - self.origin for end in self.moving_ends])

    def moving(self, tx: Tensor, rx: Pose) -> Tensor:
        """Return positions [m] of what moves: (B, 3) of one end (or one for all), or (B, 6)
        of both.
        """
        # A static receiver's pose has no leading axis, a batch of poses has one.
        place = rx.position.reshape(-1, 3)
        if self.paired:
            return torch.cat([tx, place.expand(len(tx), 3)], dim=1)
        return tx if self.moving_end == "tx" else place

    @property
    def every_station(self) -> Stations:
        """The static ends; where there are no `stations` one without a name,
        at NaN where that is unknown.

        >>> predictor.site.every_station.name, len(gsparc.load("city.ckpt").site.every_station)
        (('',), 2)
        """
        if self.stations is not None:
            return self.stations
        place = np.full(3, np.nan) if self.static_position is None else self.static_position
        return Stations(np.asarray(place, np.float64)[None], ALONE)

    @property
    def several(self) -> bool:
        """Whether there are several stations."""
        return len(self.every_station) > 1

    @property
    def carriers(self) -> np.ndarray:
        """(T,) float64 [Hz] of every station; NaN where unknown."""
        own, shared = (
            self.every_station.carrier_hz,
            np.nan if self.carrier_hz is None else self.carrier_hz,
        )
        return np.full(len(self.every_station), shared, np.float64) if own is None else own

    @property
    def maps_levels(self) -> bool:
        """Whether these are powers of one end that moves: levels over its places."""
        return self.target.is_level and not self.paired

    @property
    def has_waves(self) -> bool:
        """Whether these are complex channels at a known carrier."""
        return self.target.is_complex and self.carrier_hz is not None

    @property
    def moving_ends(self) -> tuple[End, ...]:
        """The ends that move, in the order of `Measurements.moving`."""
        return tuple(end for end in ENDS_OF_PLACES if end != self.static_end)

    @property
    def antenna_end(self) -> End:
        """The end whose antennas a channel's are: receivers' where an array is named, else of what
        stands.
        """
        named = self.array is not None or self.every_station.array is not None
        return "rx" if named else self.static_end or "rx"

    @property
    def query_box(self) -> np.ndarray:
        """The box for each end that moves, (2, 3) or (2, 6) [m]: of what `moving` gives."""
        return np.tile(self.box, len(self.moving_ends))

    @property
    def wavelength(self) -> float | None:
        """Carrier wavelength [m]; None when the carrier is unknown."""
        return None if self.carrier_hz is None else LIGHT / self.carrier_hz

    @property
    def array_problem(self) -> str | None:
        """Why these spectra cannot be modelled through the receive array; None when they can."""
        array = np.zeros((0, 3)) if self.array is None else self.array
        faults = {
            f"targets are {self.kind}, not spectra on a grid": not self.target.is_image
            or self.grid is None,
            # Plane waves at fixed elements: with a moving array each row would have another
            # manifold.
            "the receiver moves; its array must be static": self.static_end != "rx",
            "the dataset declares no antenna array": len(array) < 2,
            "all antennas of the declared array are at one place": not (array != array[:1]).any(),
            "the carrier is unknown": self.wavelength is None,
        }
        return next((fault for fault, holds in faults.items() if holds), None)

    def array_geometry(self) -> tuple[np.ndarray, SphereGrid, float]:
        """Return the array (M, 3) [m], grid and wavelength [m]
        of spectra whose `array_problem` is None.
        """
        assert self.array is not None and self.grid is not None and self.wavelength is not None
        return self.array, self.grid, self.wavelength

    def power_unit(self, name: str | None = None) -> PowerUnit:
        """Return what turns stored powers into a unit and back; None: that of the measurements.

        Raises:
            ValueError: see `PowerUnit.from_name`.
        """
        return PowerUnit.from_name(name or self.unit, self.level_unit, self.target_scale)

    def in_levels(self, unit: str | None) -> Site:
        """Return the same, its levels and answers in a unit of levels; None: as they are.

        Raises:
            ValueError: another unit, or one that these levels cannot be turned into.
        """
        wanted = PowerUnit.from_name(unit, self.level_unit, levels=True)
        scale = self.target_scale * wanted.scale ** (1 / self.target.exponent)
        return replace(self, level_unit=wanted.name, unit=wanted.name, target_scale=scale)

    def tones(self) -> np.ndarray:
        """Return frequencies (K,) float64 [Hz] of the channel;
        `ValueError` when nothing names them.
        """
        if self.subcarriers_hz is not None:
            return np.asarray(self.subcarriers_hz, dtype=np.float64)
        if self.carrier_hz is None:
            raise ValueError(
                f"{self.name}: neither subcarriers_hz nor carrier_hz is known; phase needs them"
            )
        return np.array([self.carrier_hz], dtype=np.float64)


@dataclass(frozen=True)
class Measurements:
    """A whole dataset, in memory but for large targets;
    arrays keep their stored precision and type.

    >>> predictor.site.name, predictor.site.kind  # facts of what a model learned from
    ('arrays', 'rssi')
    >>> ends, turned = np.zeros((4, 3)), np.zeros((4, 3, 3))
    >>> data = Measurements(predictor.site, ends, ends, turned, target=np.ones((4, 1), np.float32))
    >>> data.batch([1, 3]).target.shape, data.moving.shape
    (torch.Size([2, 1]), (4, 3))

    Attributes:
        site: the fixed facts.
        tx: (S, 3) float64 [m], local coordinates.
        rx_position: (S, 3) float64 [m], local coordinates.
        rx_rotation: (S, 3, 3) float64, local to world.
        target: (S, ...) uint8 (255 = 1.0), float32 or complex64, divided by `site.target_scale`.
        mask: bool like target, or None.
        noise_variance: (S,) float32, or None.
        directions: list of (paths, 3) unit vectors per sample, receiver frame, or None.
        row_names: name of each row for messages (file name, CSV line).
        release_split: (train, test) int64 rows that the data themselves name, or None.
        provenance: where the data came from, as their makers wrote it down.
        uplink: (S, U, L) complex64 received at the same moment as the target, in its units, or
            None.
        station: (S,) int64, which of `site.stations` a row is of; None where there is one.
        place: (S,) int64, the number of the place that a row is of: one place, several stations, or
            visits; None where every row is one.
        censored: (S,) int8, 1 where a power was below what can be heard and the target is that
            level, -1 where the receiver was saturated and the power is above the target, 0 where it
            was measured; the mask of the former two is False. None where nothing is.
        run: (S,) int64; channels of one run share an unknown complex factor. None where all are in
            phase.
        position_std: (S,) float64 [m], standard deviation of each coordinate of the end that moves;
            None where positions count as exact.
        sequence: (S,) int64, number of each row in the order in which they were taken; None: as
            they stand.
        device: (S,) int64, which of `site.device_names` measured a row; None where nothing tells,
            or their offsets are taken off.
    """

    site: Site
    tx: np.ndarray
    rx_position: np.ndarray
    rx_rotation: np.ndarray
    target: np.ndarray
    mask: np.ndarray | None = None
    noise_variance: np.ndarray | None = None
    directions: list[np.ndarray] | None = None
    row_names: list[str] = field(default_factory=list)
    release_split: TrainTest | None = None
    provenance: dict[str, str] = field(default_factory=dict)
    uplink: np.ndarray | None = None
    station: np.ndarray | None = None
    place: np.ndarray | None = None
    censored: np.ndarray | None = None
    run: np.ndarray | None = None
    position_std: np.ndarray | None = None
    sequence: np.ndarray | None = None
    device: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.target)

    @property
    def ends(self) -> dict[End, np.ndarray]:
        """Positions (S, 3) [m] by end."""
        return {"tx": self.tx, "rx": self.rx_position}

    def with_ends(self, places: Mapping[End, np.ndarray]) -> Measurements:
        """Return the same with ends at other places (S, 3) [m]."""
        ends = {**self.ends, **places}
        return replace(self, tx=ends["tx"], rx_position=ends["rx"])

    @property
    def moving(self) -> np.ndarray:
        """Positions of what moves, (S, 3) or of both ends (S, 6), float64 [m]:
        the query of every method.
        """
        moving = [self.ends[end] for end in self.site.moving_ends]
        return np.hstack(moving) if len(moving) > 1 else moving[0]

    @property
    def carrier_hz(self) -> np.ndarray | None:
        """Carrier (S,) [Hz] of each row where stations are told apart by theirs, else None."""
        carriers = self.site.every_station.carrier_hz
        return None if carriers is None else carriers[self.stations_of()]

    def powers(self, rows: Chosen = slice(None)) -> np.ndarray:
        """Return powers (n, D) float64 of the entries of rows (n,), in physical units."""
        target, stored = self.site.target, self.target.reshape(len(self), -1)[rows]
        return target.power(stored) * self.site.target_scale**target.exponent

    def censored_side(self, rows: Chosen = slice(None)) -> np.ndarray:
        """Return `censored` of rows (n,), (n,) int8; 0 of each where nothing is."""
        return (np.zeros(len(self)) if self.censored is None else self.censored)[rows].astype(
            np.int8
        )

    def stations_of(self, rows: Chosen = slice(None)) -> np.ndarray:
        """Return `station` of rows (n,), (n,) int64; 0 of each where there is one."""
        return np.zeros(len(self), np.int64)[rows] if self.station is None else self.station[rows]

    def runs_of(self, rows: Chosen = slice(None)) -> np.ndarray:
        """Return `run` of rows (n,), (n,) int64; 0 of each where all are in phase."""
        return np.zeros(len(self), np.int64)[rows] if self.run is None else self.run[rows]

    def targets(self, index: np.ndarray | Tensor) -> Tensor:
        """Return targets of the given rows as float32 or complex64, in stored units."""
        chosen = torch.from_numpy(np.ascontiguousarray(self.target[np.asarray(index)]))
        # uint8 images are kept as read, a quarter of float32's memory, and become [0,
        # 1] by batches.
        return chosen.float() / 255 if chosen.dtype == torch.uint8 else chosen

    def subset(self, rows: np.ndarray, site: Site | None = None) -> Measurements:
        """Return rows (n,) alone, seen as measurements of `site`."""

        def take_rows(value: Any) -> Any:
            # Lists may be empty, for instance row names of data made from arrays.
            return (
                [value[i] for i in rows if value] if isinstance(value, list) else take(value, rows)
            )

        # A release's split names rows of the whole, which the subset numbers otherwise.
        whole = ("site", "provenance", "release_split")
        arrays = {name: value for name, value in vars(self).items() if name not in whole}
        parts = {name: take_rows(value) for name, value in arrays.items() if value is not None}
        return Measurements(site=site or self.site, provenance=self.provenance, **parts)

    def batch(self, index: np.ndarray | Tensor) -> Batch:
        """Return the given rows as one batch."""
        rows = np.asarray(index)
        # One pose for the whole batch: kernels then plan the view once.
        shared = self.site.static_end == "rx" and not self.site.several
        seen = rows[0] if shared else rows
        rx = Pose(self._f32(self.rx_position[seen]), self._f32(self.rx_rotation[seen]))
        optional = ((name, getattr(self, name)) for name in ("mask", "uplink", "station", "run"))
        parts: dict[str, Any] = {
            name: torch.from_numpy(v[rows]) for name, v in optional if v is not None
        }
        return Batch(
            index=torch.from_numpy(rows.astype(np.int64)),
            tx=self._f32(self.tx[rows]),
            rx=rx,
            target=self.targets(rows),
            noise_variance=None
            if self.noise_variance is None
            else self._f32(self.noise_variance[rows]),
            **parts,
        )

    @staticmethod
    def _f32(array: np.ndarray) -> Tensor:
        # Local coordinates are centred on the site: at 500 m float32 has steps of 0.03 mm.
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
