"""Layers of a map as they are drawn: values, what colours mean, names of classes; where the
strongest station's level changed since the map was learned (`gsparc update`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize, to_hex
from scipy.ndimage import distance_transform_edt
from scipy.ndimage import label as areas_of

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.strongest import OVERLAP_DB, REFUSED, best_server
from gsparc.prediction.predictor import Predictor

MOST_OVERLAP = 5.0  # stations that the colours end with
UNKNOWN = "#AAAAAA"  # of values that are not known
SHADES = (0.0, 0.45, -0.35, 0.7, -0.6)  # of the stations of a site: towards white, or black
BESIDE = 2  # cells between areas that must not have one colour
MOST_COLOURS = 10
DEEP = 0.025  # of the map's longer side, from the edge of an area that its name is written on
UNSURE = "hatched: another station leads more likely than this one"
SILENT = "dotted: more likely than not none is heard"
NO_RATIO = "white: no other cell on this carrier, and noise_db= is not given"


@dataclass(frozen=True)
class Legend:
    """What colours mean: from `low` to `high` of `label`, in a matplotlib colour map."""

    label: str
    low: float
    high: float
    colours: str = "viridis"

    def to_colours(self, values: np.ndarray) -> np.ndarray:
        """Return colours (..., 3) uint8 of values (...); grey where they are not finite."""
        # Masked: what is infinite is grey, too, instead of the colour of an end.
        share = Normalize(self.low, self.high, clip=True)(np.ma.masked_invalid(values))
        return colormaps[self.colours].with_extremes(bad=UNKNOWN)(share, bytes=True)[..., :3]

    @classmethod
    def over(cls, label: str, values: np.ndarray, colours: str = "viridis") -> Legend:
        """Return colours from the 1 to the 99 % quantile of those values that are finite."""
        finite_values = values[np.isfinite(values)]
        # One and 99 %: a cell at a mast would leave one colour for the rest.
        low, high = np.percentile(finite_values, [1, 99]) if len(finite_values) else (0.0, 1.0)
        return cls(label, float(low), float(high if high > low else low + 1.0), colours)


@dataclass(frozen=True)
class Layer:
    """A layer as it is drawn.

    Attributes:
        name: of its file and its button.
        values: (ny, nx) float, NaN where nothing is said.
        legend: what its colours mean, with the unit.
        words: names of whole numbers, for a layer of classes.
        group: (n,) of each class, those of one have shades of one colour; None: each is one.
        doubts: (ny, nx) bool cells that are hatched, how, and why.
        blank: why values may be missing where something is said.
    """

    name: str
    values: np.ndarray
    legend: Legend
    words: tuple[str, ...] = ()
    doubts: Sequence[tuple[np.ndarray, str, str]] = ()
    group: np.ndarray | None = None
    blank: str = ""

    def table(self) -> np.ndarray:
        """Return colours (n, 4) from the lower to the upper end of the legend: of each class,
        or 256.
        """
        if not self.words:
            return colormaps[self.legend.colours](np.linspace(0, 1, 256))
        groups = np.arange(len(self.words)) if self.group is None else self.group
        number = np.unique(groups, return_inverse=True)[1]
        where = np.append(number, np.nan)[np.nan_to_num(self.values, nan=len(number)).astype(int)]
        tint = assign_colours(where, int(number.max()) + 1)[number]  # fewer than plain stations
        colours, rank = (
            np.asarray(colormaps["tab10"](tint)),
            np.tril(tint[:, None] == tint, -1).sum(1),
        )
        shade = np.array(SHADES)[rank % len(SHADES)][:, None]
        # A positive share goes to white, a negative one to black.
        colours[:, :3] += np.abs(shade) * ((shade > 0) - colours[:, :3])
        return colours

    def class_table(self) -> dict[str, list[Any]]:
        """Return columns of its classes, largest first: number, name,
        share of the map and colour.
        """
        count = np.bincount(
            self.values[np.isfinite(self.values)].astype(int), minlength=len(self.words)
        )
        order = np.argsort(-count, kind="stable").tolist()
        share, colour = count / max(count.sum(), 1), self.table()
        return {
            "number": order,
            "station": [self.words[k] for k in order],
            "share": [round(float(share[k]), 4) for k in order],
            "colour": [to_hex(colour[k]) for k in order],
        }


def assign_colours(classes: np.ndarray, count: int) -> np.ndarray:
    """Return numbers (count,) below `MOST_COLOURS`, different for classes
    (ny, nx) that lie beside each other.
    """
    if count <= MOST_COLOURS:
        return np.arange(count)
    number = np.where(np.isfinite(classes), classes, count).astype(int)
    beside = np.zeros((count + 1, count + 1), int)
    # Two cells: areas that a thin strip parts look as if they met.
    for step in range(1, BESIDE + 1):
        np.add.at(beside, (number[step:], number[:-step]), 1)
        np.add.at(beside, (number[:, step:], number[:, :-step]), 1)
    beside += beside.T
    result = np.full(count, -1)
    # Large areas first, which have most neighbours, then the rest by what is left.
    for area in np.argsort(
        -np.bincount(number.reshape(-1), minlength=count)[:count], kind="stable"
    ):
        used = result >= 0
        near = np.bincount(result[used], beside[area, :count][used], MOST_COLOURS)
        # Fewest borders of one colour first, of these the colour that is used least.
        result[area] = np.lexsort((np.bincount(result[used], minlength=MOST_COLOURS), near))[0]
    return result


def label_places(classes: np.ndarray, words: tuple[str, ...]) -> Iterator[tuple[int, int, str]]:
    """Return row, column and name for each area of classes (ny, nx)
    that is wide enough to be written on.
    """
    # Deeper than a letter at the picture's size, or the name hides its area.
    least = max(DEEP * max(classes.shape), 1.5)
    for number in np.unique(classes[np.isfinite(classes)]).astype(int):
        parts, count = areas_of(classes == number)
        for part in range(1, count + 1):
            # Padded, since the map's edge ends an area as well.
            deep = distance_transform_edt(np.pad(parts == part, 1))[1:-1, 1:-1]
            if deep.max() >= least:
                yield (
                    *(int(at) for at in np.unravel_index(deep.argmax(), deep.shape)),
                    words[number],
                )


def list_layers(field: FieldMap) -> Iterator[Layer]:
    """List every layer of a map that says something; of several stations,
    also the power of each.
    """
    several, unit = len(field.stations) > 1, field.unit
    of = " of the strongest station" if several else ""
    layer = field.layer("power_db")
    yield Layer("power", layer, Legend.over(f"received power{of} [{unit}]", layer))
    if several:
        doubts = (field.other_leads, "////", UNSURE), (field.quiet, "....", SILENT)
        best = field.layer("best_server")
        yield _servers("best_server", best, field.stations, field.site, doubts)
    for band in dict.fromkeys(field.bands):
        its = np.array(field.bands) == band
        powers, names = field.power_db[its], tuple(np.array(field.stations)[its].tolist())
        if not np.isfinite(powers).any():
            continue
        strongest = best_server(powers.reshape(len(powers), -1)).reshape(field.grid.inside.shape)
        level = np.take_along_axis(powers, np.maximum(strongest, 0).astype(np.int64)[None], 0)[0]
        yield Layer(
            f"power {band}", level, Legend.over(f"received power at {band} [{unit}]", level)
        )
        where = np.where(strongest == REFUSED, np.nan, strongest)
        yield _servers(f"best_server {band}", where, names, field.site[its], ())
    if np.isfinite(field.sinr_db).any():
        label = "signal over interference and noise [dB]"
        legend = Legend.over(label, field.sinr_db)
        yield Layer("sinr", field.sinr_db, legend, blank=NO_RATIO)
    label = f"probability of less than {field.threshold_db:g} {unit}"
    yield Layer("outage", field.outage, Legend(label, 0.0, 1.0, "magma_r"))
    error, width = (
        field.layer("expected_error_db"),
        field.at_best_server(field.upper_db - field.lower_db),
    )
    yield Layer("expected_error", error, Legend.over("expected error [dB]", error, "cividis"))
    label = f"width of the {field.share:.0%} interval [dB]"
    yield Layer("width", width, Legend.over(label, width, "cividis"))
    if "overlap" in field.extra:
        label = f"stations within {OVERLAP_DB:g} dB of the strongest, on its carrier"
        yield Layer("overlap", field.extra["overlap"], Legend(label, 1.0, MOST_OVERLAP, "YlOrRd"))
    for name, layer in zip(field.stations, field.power_db, strict=True) if several else ():
        if np.isfinite(layer).any():
            yield Layer(
                f"power {name}", layer, Legend.over(f"received power of {name} [{unit}]", layer)
            )


def _servers(
    name: str, number: np.ndarray, stations: tuple[str, ...], site: np.ndarray, doubts: Any
) -> Layer:
    legend = Legend("strongest station", -0.5, len(stations) - 0.5)
    return Layer(name, number, legend, stations, doubts, site if len(site) else None)


def file_name(layer: Layer, suffix: str = ".png") -> str:
    """Return the name of its file, without what a file system may not like."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in layer.name) + suffix


CHANGE, DEVIATION = "change_db", "change_deviation_db"
# Deviations that a change is said to be sure from; least end of the colours [dB]
SURE, LEAST = 2.0, 1.0


def add_changes(field: FieldMap, predictor: Predictor, dry: bool = False) -> FieldMap:
    """Return a map with two further layers (ny, nx) [dB]: the mean of what changed,
    and its deviation.

    Of a model that no later rows were told to it is returned as it is. `dry`:
    the layers without values.
    """
    if not predictor.versions or not len(predictor.rows):
        return field
    layers = np.full((2, field.best_server.size), np.nan, np.float32)
    for row, number in enumerate([] if dry else field.number):
        cells = np.flatnonzero(field.best_server.reshape(-1) == row)
        if len(cells):
            model = predictor.ask_station(int(number))
            layers[:, cells] = model.change(**model.site.name_moving(field.grid.places(cells)))
    change, deviation = layers.reshape(2, *field.best_server.shape)
    return replace(field, extra={**field.extra, CHANGE: change, DEVIATION: deviation})


def change_layers(field: FieldMap) -> Iterator[Layer]:
    """List what `add_changes` added, as it is drawn."""
    if CHANGE not in field.extra:
        return
    change, deviation = field.extra[CHANGE], field.extra[DEVIATION]
    most = max(float(np.nanmax(np.abs(change), initial=0.0)), LEAST)
    why = f"within {SURE:g} deviations of no change"
    doubt = np.abs(change) < SURE * deviation, "////", why
    yield Layer(
        "change", change, Legend("change of the level [dB]", -most, most, "RdBu_r"), doubts=[doubt]
    )
    label = "deviation of the change [dB]"
    yield Layer("change_deviation", deviation, Legend.over(label, deviation, "cividis"))
