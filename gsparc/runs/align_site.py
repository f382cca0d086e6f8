"""Other measurements of a model's site, in its coordinates, units and numbers of stations."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from gsparc.base.errors import list_first
from gsparc.data.ends import SAME_PLACE_M
from gsparc.data.schema import Measurements, Site, Stations
from gsparc.data.station_names import all_names
from gsparc.data.units import WATTS
from gsparc.models.method import MEAN_DEVICE

log = logging.getLogger(__name__)

ANOTHER = "give data with as many, or another ckpt"


def align_to_site(
    data: Measurements, site: Site, *, whole: bool = False, keep_new: bool = False
) -> Measurements:
    """Return `data` in the local coordinates and target units (watts, milliwatts)
    of a model's training.

    Rows of stations that the model does not know are left out, which is logged; `whole`:
    they are refused; `keep_new`: those at other places follow the model's own.

    Raises:
        ValueError: another kind, grid, moving end or static place, or no station that the model
            knows.
    """
    ours = data.site
    for name in ("kind", "static_end", "grid"):
        ours_value, site_value = getattr(ours, name), getattr(site, name)
        if ours_value != site_value:
            raise ValueError(
                f"the model was trained with {name} {site_value}, {ours.name} has {ours_value}"
            )
    data = _about(data, site)
    if site.unknown_factor != "none":  # few rows of another file may not tell
        data = replace(data, site=replace(data.site, unknown_factor=site.unknown_factor))
    data = _with_devices(_with_entries(data, site), site)
    ours = data.site
    shift = ours.origin - site.origin
    if ours.static_position is not None and site.static_position is not None:
        gap = float(np.linalg.norm(ours.static_position + shift - site.static_position))
        if gap > SAME_PLACE_M:
            raise ValueError(
                f"the static {ours.static_end} of {ours.name} is {gap:.3g} m from the model's"
            )
    data = _renumbered(data, site, shift, whole, keep_new)
    ours = data.site
    units, rescale = (ours.level_unit, site.level_unit), ours.target_scale / site.target_scale
    if set(units) <= set(WATTS):  # what is called dB may be either
        rescale *= WATTS[units[0]] / WATTS[units[1]]
    same_units = ours.level_unit == site.level_unit and ours.target_scale == site.target_scale
    if same_units and not shift.any() and rescale == 1:
        return data
    site_value = replace(
        ours,
        origin=site.origin,
        box=ours.box + shift,
        static_position=site.static_position,
        target_scale=site.target_scale,
        level_unit=site.level_unit,
        unit=site.unit,
    )
    return replace(
        data,
        site=site_value,
        tx=data.tx + shift,
        rx_position=data.rx_position + shift,
        target=_times(data.target, rescale),
        uplink=_times(data.uplink, rescale),
        # Variances are of the square of the unit.
        noise_variance=_times(data.noise_variance, rescale**2),
    )


def _with_entries(data: Measurements, site: Site) -> Measurements:
    """`data` with the antennas and tones that a model learned;
    those that it lacks were not measured.
    """
    if not site.target.is_complex or (data.site.measured is None and site.measured is None):
        return data
    have, want = (described.measured for described in (data.site, site))
    shape = data.target.shape[1:] if have is None else have.shape
    want = np.ones(shape, bool) if want is None else want
    if want.shape != shape:
        raise ValueError(
            f"the model was trained on {want.shape} antennas and tones, {data.site.name} has "
            f"{shape}"
        )
    known = np.ones(data.target.shape, bool) if data.mask is None else data.mask
    target, mask = (np.zeros((len(data), *shape), array.dtype) for array in (data.target, known))
    for whole, part in ((target, data.target), (mask, known)):
        whole[:, np.ones(shape, bool) if have is None else have] = part.reshape(len(data), -1)
    rows, columns = want.any(1), want.any(0)
    facts = {n: getattr(site, n) for n in ("subcarriers_hz", "array", "antennas", "measured")}
    there = replace(data.site, **facts)
    target, mask = (whole[:, rows][:, :, columns] for whole in (target, mask))
    return replace(data, site=there, target=target, mask=mask)


def _with_devices(data: Measurements, site: Site) -> Measurements:
    """`data` with the numbers that a model has for devices, by their names;
    unknown ones are the mean one.
    """
    if data.device is None or data.site.device_names == site.device_names:
        return data
    known = {name: number for number, name in enumerate(site.device_names or ())}
    number = np.array([known.get(name, MEAN_DEVICE) for name in data.site.device_names or ()])
    device = number[data.device] if known else None
    return replace(data, device=device, site=replace(data.site, device_names=site.device_names))


def _about(data: Measurements, site: Site) -> Measurements:
    """`data` in metres about the place on Earth that those of `site` are about,
    where both say which.
    """
    reference, there = data.site.georeference, site.georeference
    if reference is None or there is None or reference == there:
        return data

    def moved(local: np.ndarray) -> np.ndarray:
        world = local + data.site.origin
        # Stations may be at unknown places, NaN, which no projection takes.
        finite = np.isfinite(world).all(axis=1)
        # Through degrees: metres about two origins differ by scale and rotation,
        # not by a shift alone.
        world[finite, :2] = there.from_degrees(*reference.to_degrees(world[finite, :2]))
        return world - data.site.origin

    still, stations = data.site.static_position, data.site.stations
    facts = replace(
        data.site,
        georeference=there,
        box=moved(data.site.box),
        static_position=None if still is None else moved(still[None])[0],
        stations=None if stations is None else replace(stations, position=moved(stations.position)),
    )
    return replace(data, site=facts, tx=moved(data.tx), rx_position=moved(data.rx_position))


def _renumbered(
    data: Measurements, site: Site, shift: np.ndarray, whole: bool, keep_new: bool
) -> Measurements:
    """`data` with the numbers that a model of `site` has for its stations; `shift` (3,)
    [m] leads there.

    Another file, or part of one, may list them in another order. They are known by their places,
    and where several stand at one, by their names.
    """
    ours, theirs = data.site.stations, site.stations
    if ours is None and keep_new and data.site.static_position is not None:
        ours = data.site.every_station
    if ours is None or theirs is None:
        if ours is theirs or (
            data.site.static_position is not None and site.static_position is not None
        ):
            return data  # one place, a table of one or not
        have = ["one static end" if of is None else f"{len(of)} stations" for of in (ours, theirs)]
        raise ValueError(f"{data.site.name} has {have[0]}, the model {have[1]}; {ANOTHER}")
    # A list of cells has names of its own beside those that a drive gives them.
    called, learned = (
        [*map(set, zip(of.name, of.label or of.name, strict=True))] for of in (ours, theirs)
    )
    gap = np.linalg.norm(ours.position[:, None] + shift - theirs.position, axis=2)
    number = np.full(len(ours), -1)
    for t, names in enumerate(called):
        # Sectors of one mast share a place: there the name decides,
        # as it does where nobody knows the place.
        alike = [
            i for i, labels in enumerate(learned) if names & labels and not gap[t, i] > SAME_PLACE_M
        ]
        near = np.flatnonzero(gap[t] <= SAME_PLACE_M).tolist()
        if alike or len(near) == 1:
            number[t] = (alike or near)[0]
    new = np.flatnonzero((number < 0) & keep_new & np.isfinite(ours.position).all(1))
    if len(new):
        number[new] = len(theirs) + np.arange(len(new))
        places = np.concatenate([theirs.position, ours.position[new] + shift])
        theirs = Stations(places, (*theirs.name, *(ours.name[t] for t in new)))
    is_known = number[data.stations_of()] >= 0
    if not is_known.all():
        fault = _explain_unknown(data.site.name, ours, theirs, number < 0)
        if whole or not is_known.any():
            advice = "; dataset.stations=[NAME,...] keeps the others" if is_known.any() else ""
            raise ValueError(fault + advice)
        log.warning("%s: %d of %d rows are left out", fault, (~is_known).sum(), len(is_known))
        data = data.subset(np.flatnonzero(is_known))
    facts = replace(data.site, stations=theirs, static_position=site.static_position)
    end = facts.still_end
    station = number[data.stations_of()]
    there = (theirs.position - shift)[station]
    # Of a place that one of both does not know, all is as the model learned it.
    still = np.where(np.isfinite(there + data.ends[end]), data.ends[end], there)
    return replace(data.with_ends({end: still}), station=station, site=facts)


def _explain_unknown(source: str, ours: Stations, theirs: Stations, unknown: np.ndarray) -> str:
    """Which stations of a file a model does not know, and what to do where it knows none."""
    names = [ours.name[t] for t in np.flatnonzero(unknown)]
    fault = (
        f"stations {list_first(names)} of {source} are none of the model's, "
        f"{list_first(theirs.name)}"
    )
    if not {*all_names(ours)} & {*all_names(theirs)}:
        way = (
            "dataset.columns.station=COLUMN takes another column, dataset.stations_file=FILE a list"
        )
        return f"{fault}: no name in common; {way} that has both"
    return f"{fault}, by name and place"


def _times(values: Any, factor: float) -> Any:
    """An array in another unit, of the same type."""
    return values if values is None or factor == 1 else (values * factor).astype(values.dtype)
