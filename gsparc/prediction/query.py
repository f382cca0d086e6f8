"""World positions as what a method is asked: in local coordinates, both ends, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsparc.base.errors import DataError
from gsparc.base.limits import finite_array
from gsparc.data.assemble import FARTHEST
from gsparc.data.ends import SAME_PLACE_M
from gsparc.data.query import Query
from gsparc.data.schema import End, Site
from gsparc.models.method import Method
from gsparc.ops import Pose
from gsparc.ops.transforms import to_numpy

if TYPE_CHECKING:
    from gsparc.data.georeference import Georeference

# Steps of float32 from 131 km from the world's origin on, as in UTM: phases are lost
COARSE_M = 0.01


class PlacedQuery(NamedTuple):
    """A query, and in which form its answers are wanted.

    Attributes:
        query: of B places, or of each of `asked` at every place in turn.
        single: whether one position was given.
        as_torch: whether tensors were.
        asked: (t,) numbers of the stations that all places are asked of; None where the query says
            which, or there is one.
        stations: names of all T.
    """

    query: Query
    single: bool
    as_torch: bool
    asked: Tensor | None = None
    stations: tuple[str, ...] = ()

    def of_one(self) -> Query:
        """Return the query of one station; `ValueError` where it is of several."""
        if self.asked is not None:
            raise ValueError(f"use select_station(name): one of {', '.join(self.stations)}")
        return self.query

    def at_stations(self, places: Tensor) -> Tensor:
        """Return places (B, 3) or (3,) of one end as those of all rows (B t, 3)."""
        each = 1 if self.asked is None else len(self.asked)
        places = places.expand(len(self.query) // each, 3)
        return places if self.asked is None else places.repeat_interleave(each, 0)

    def by_station(self, values: Tensor) -> Tensor:
        """Return answers (B t, ...) as (B, T, ...), powers (B, T); NaN, or no, of stations without
        an answer.
        """
        if self.asked is None:
            return values
        rest = () if values.shape[1:] == (1,) else values.shape[1:]
        values = values.reshape(-1, len(self.asked), *rest)
        if len(self.asked) == len(self.stations):
            return values
        absent = False if values.dtype == torch.bool else torch.nan
        whole = values.new_full((len(values), len(self.stations), *rest), absent)
        whole[:, self.asked] = values
        return whole

    def match(self, values: Tensor) -> Any:
        """Return answers (B, ...) as they were asked for: of one place, as tensors or NumPy
        arrays.
        """
        values = values[0] if self.single else values
        if self.as_torch:
            return values
        return values.numpy() if values.ndim else float(values)


class Queries:
    """Queries of one site; see `Predictor`.

    Args:
        site: of the model, or what one of its stations sees.
        station: its number, where a model of all is asked: two may stand at one place.
        answered: numbers of stations that have an answer, which places are asked of where neither
            end says which; empty: that is refused.
    """

    def __init__(
        self, site: Site, station: int | None = None, answered: Sequence[int] = ()
    ) -> None:
        self.station, self.answered = station, torch.tensor(answered, dtype=torch.long)
        self.site, still = site, site.static_position if site.static_end == "rx" else None
        # The pose of a receiver that never moved, made once.
        self._still = (
            None if still is None else Pose(_float(still), _float(self._rx_rotation(None, 1)))
        )

    def query(self, tx: Any, rx: Any, dtype: torch.dtype = torch.float32) -> PlacedQuery:
        """Check both ends as they were given, and return what is asked."""
        receiver = rx.position if isinstance(rx, Pose) else rx
        places = {
            end: read_places(end, value)
            for end, value in (("tx", tx), ("rx", receiver))
            if value is not None
        }
        moving, static = self.site.moving_end, self.site.still_end
        for needed in sorted(self.site.moving_ends):  # the receiver first
            if needed not in places:
                raise ValueError(
                    f"{needed}= is needed: it moved when {self.site.name} was measured"
                )
        single = all(place.ndim == 1 for place in places.values())
        common = self._still is not None and len(places) == 1 and dtype == torch.float32
        if self._still is not None and common:  # with nothing to look up
            sender = _float(np.atleast_2d(places[moving] - self.site.origin))
            query = Query(sender, self._still, self._stations(len(sender)))
            return PlacedQuery(query, single, isinstance(tx, Tensor))
        local = {end: np.atleast_2d(place) - self.site.origin for end, place in places.items()}
        # One place of an end goes with any number of the other's.
        count = max(len(place) for place in local.values())
        for end, place in local.items():
            if len(place) not in (1, count):
                raise ValueError(f"{end}= holds {len(place)} positions, the other end {count}")
        asked, rotation = self._asked(static in local), self._rx_rotation(rx, count)
        number = self._stations(count)
        if asked is not None:
            number = asked.repeat(count)
            row = np.arange(count).repeat(len(asked))
            local = {moving: np.broadcast_to(local[moving], (count, 3))[row]}
            rotation = self._turned(rotation, number.numpy(), row)
            local[static] = self.site.every_station.position[number.numpy()]
            count = len(row)
        ends = {moving: local[moving], static: self._static_place(local.get(static))}
        if static == "rx" and rotation.ndim == 2 and ends["rx"].ndim == 1:
            pose = Pose(_float(ends["rx"], dtype), _float(rotation, dtype))
        else:
            positions = np.broadcast_to(ends["rx"], (count, 3))
            turned = np.broadcast_to(rotation, (count, 3, 3))
            pose = Pose(_float(positions, dtype), _float(turned, dtype))
        sender = _float(np.broadcast_to(ends["tx"], (count, 3)), dtype)
        as_torch = any(isinstance(v, Tensor) for v in (tx, receiver))
        names = self.site.every_station.shown
        return PlacedQuery(Query(sender, pose, number), single, as_torch, asked, names)

    def _asked(self, stands: bool) -> Tensor | None:
        """Numbers (t,) of the stations that places are asked of; None where a query says which."""
        said = stands or self.station is not None or self.site.static_position is not None
        return (
            None if said or self.site.stations is None or not len(self.answered) else self.answered
        )

    def _turned(self, rotation: np.ndarray, number: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Rotations (n, 3, 3) or (3, 3) of receivers: stations have their own."""
        stations = self.site.every_station.rotation
        if self.site.static_end == "rx" and stations is not None:
            return stations[number]
        return rotation[row % len(rotation)] if rotation.ndim == 3 else rotation

    def _stations(self, count: int) -> Tensor | None:
        return None if self.station is None else torch.full((count,), self.station)

    def _static_place(self, place: np.ndarray | None) -> np.ndarray:
        """Local position (3,) or (B, 3) of the static end;
        a known one must be where it was measured.
        """
        position, end = self.site.static_position, self.site.static_end
        if position is None:
            if place is not None:
                return place[0] if len(place) == 1 else place
            if self.site.stations is not None:
                raise ValueError(
                    f"use select_station(name): one of {', '.join(self.site.stations.shown)}"
                )
            if not self.site.target.is_image:  # learned without its transmitter's place
                return np.full(3, np.nan)
            raise ValueError(f"{end}= is needed: the model does not say where its static end stood")
        if place is not None and (np.linalg.norm(place - position, axis=-1) > SAME_PLACE_M).any():
            stood = np.array2string(position + self.site.origin, precision=3, separator=", ")
            raise ValueError(
                f"{end}= differs from where it stood when measured, {stood} m: leave it out"
            )
        return position

    def _rx_rotation(self, rx: Any, count: int) -> np.ndarray:
        if isinstance(rx, Pose):
            rotation = to_numpy(rx.rotation).astype(np.float64)
            if rotation.ndim == 3 and len(rotation) not in (1, count):
                raise ValueError(f"rx= holds {len(rotation)} rotations for {count} positions")
            return rotation
        return np.eye(3) if self.site.rx_rotation is None else self.site.rx_rotation


def usual_heights(site: Site) -> dict[End, float]:
    """Return the world height [m] of each end that moved and was always at the same height.

    >>> usual_heights(predictor.site)
    {'rx': 1.5}
    """
    low, high = site.moving_box[:, 2::3]
    ends = enumerate(site.moving_ends)
    # Rounded: the origin was taken away from it.
    return {end: round(float(low[i] + site.origin[2]), 9) for i, end in ends if low[i] == high[i]}


def read_places(end: str, value: Any) -> np.ndarray:
    """Read (3,) or (B, 3) [m] as float64 until the origin is subtracted,
    or far sites lose millimetres.

    >>> read_places("rx", [[0.0, 1.0, 2.0]]).shape
    (1, 3)
    >>> read_places("rx", [0.0, 1.0])
    Traceback (most recent call last):
        ...
    ValueError: rx= must be (3,) or (B, 3) [m], got shape (2,)
    """
    try:
        array = to_numpy(value) if isinstance(value, Tensor) else np.asarray(value)
        array = array.astype(
            np.float64, casting="same_kind" if array.dtype.kind == "c" else "unsafe"
        )
    except (TypeError, ValueError):
        raise ValueError(f"{end}= must be real numbers [m], got {type(value).__name__}") from None
    if array.ndim not in (1, 2) or array.shape[-1] != 3 or not array.size:
        raise ValueError(f"{end}= must be (3,) or (B, 3) [m], got shape {array.shape}")
    if not np.isfinite(array).all():
        row = (
            ""
            if array.ndim == 1
            else f" in row {int(np.flatnonzero(~np.isfinite(array).all(1))[0])}"
        )
        raise ValueError(f"{end}= holds NaN or Inf{row}")
    if np.abs(array).max() > FARTHEST:
        raise ValueError(
            f"{end}= holds {np.abs(array).max():.3g}; expected metres, none beyond {FARTHEST:g}"
        )
    step = float(np.spacing(np.float32(np.abs(array).max())))
    if getattr(value, "dtype", None) in (np.float32, torch.float32) and step > COARSE_M:
        raise ValueError(
            f"{end}= is float32, which moves in steps of {step:.2g} m there; give float64"
        )
    return array


class Asked:
    """What all that a `Predictor` says rests on.

    Attributes:
        site: of the model, or what one of its stations sees.
        method: answers.
        queries: of the site.
    """

    site: Site
    method: Method
    _whole: Method  # asked for variance and confidence, which `method` may spare
    queries: Queries


class DegreesMixin(Asked):
    """What a `Predictor` says of latitudes and longitudes."""

    def metres(self, latitude: Any, longitude: Any, height: Any = None) -> np.ndarray:
        """Return world positions (B, 3) float64 [m] of places (B,) [deg], or (3,) of one place.

        >>> city = gsparc.load("city.ckpt")
        >>> city.select_station("roof-3").rssi(rx=city.metres(40.7652, -111.8348)).shape
        (1,)

        Args:
            latitude, longitude: [deg], longitude to the east.
            height: () or (B,) [m]; None for the one height at which the moving end was measured.

        Raises:
            ValueError: measured in metres about an unknown origin, degrees that are not on Earth,
                or no height where the moving end had several.
        """
        origin = self._georeference()
        if height is None:
            height = usual_heights(self.site).get(self.site.moving_end)
        if height is None:
            raise ValueError(
                f"height= is needed: the {self.site.moving_end} had several, or none is known"
            )
        single = np.ndim(latitude) == 0 and np.ndim(longitude) == 0 and np.ndim(height) == 0
        across = origin.from_degrees(latitude, longitude)
        try:
            above = np.broadcast_to(np.asarray(height, np.float64), len(across))
        except (TypeError, ValueError):
            raise ValueError(f"height= must be one number or {len(across)} [m]") from None
        places = np.column_stack([across, above])
        return places[0] if single else places

    def degrees(self, position: Any) -> tuple[Any, Any, Any]:
        """Return latitude and longitude (B,) [deg] and height (B,) [m] of world positions (B, 3)
        or (3,) [m].

        >>> latitude, longitude, height = gsparc.load("city.ckpt").degrees([0.0, 0.0, 1.5])
        >>> height
        1.5

        Raises:
            ValueError: measured in metres about an unknown origin, or no positions.
        """
        origin = self._georeference()
        places = read_places("position", position)
        latitude, longitude = origin.to_degrees(np.atleast_2d(places)[:, :2])
        if places.ndim == 1:
            return float(latitude[0]), float(longitude[0]), float(places[2])
        return latitude, longitude, places[:, 2]

    def _georeference(self) -> Georeference:
        if self.site.georeference is None:
            raise ValueError(
                f"{self.site.name} was measured in metres about an unknown origin, not in degrees"
            )
        return self.site.georeference


def _float(array: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.from_numpy(
        np.array(array, dtype=np.float32 if dtype == torch.float32 else np.float64)
    )


def query_ends(
    site: Site,
    places: np.ndarray,
    other_end: Sequence[float] | None,
    station: np.ndarray | None = None,
) -> dict[End, np.ndarray]:
    """Return world places [m] of the ends that a predictor needs,
    the moving one at `places` (n, 3).

    `other_end` (3,) is the transmitter's place where both moved, `station` (3,)
    that of one never heard.

    Raises:
        DataError: both ends moved and nobody says where the other is, or it stood still and
            somebody does.
    """
    moving, other = site.moving_end, site.still_end
    if not site.paired:
        if other_end is not None:
            raise DataError(f"other_end: the {other} stood still; leave it out")
        return {moving: places} | ({} if station is None else {other: station})
    if other_end is None:
        raise DataError(
            "other_end: both ends moved; say where the transmitter stands, other_end=[x,y,z]"
        )
    return {
        moving: places,
        other: np.broadcast_to(read_place("other_end", other_end), places.shape),
    }


def read_place(name: str, value: Any, axes: int = 3) -> np.ndarray:
    """Return (3,) [m] of the setting `name`, with 2 `axes` also (2,);
    `DataError` where it is no place.
    """
    place = finite_array(value)
    if place.shape not in ((axes,), (3,)):
        raise DataError(
            f"{name}={value}: {('two', 'three')[axes - 2]} finite numbers [m] are needed"
        )
    return place


def to_local(site: Site, places: np.ndarray, other_end: Sequence[float] | None) -> np.ndarray:
    """Return world places (n, 3) of the moving end as local ones, (n, 6)
    of both ends where both moved [m].

    Raises:
        DataError: both moved, and nobody says where the other end stands.
    """
    return site.local_places(query_ends(site, places, other_end))
