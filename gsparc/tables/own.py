"""Measurements of one's own, and what our simulators write: one documented schema, npz or HDF5.

docs/reference/schema.md documents it; fields.csv is its table. `interpret` turns arrays into
measurements or lists everything that is wrong, `load_own` is its strict form,
`write_own` refuses what `load_own` would.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import Caution
from gsparc.base.limits import number, or_null
from gsparc.data.assemble import centre_and_hash, check_positions
from gsparc.data.fields import FIELDS, NORMALISATIONS
from gsparc.data.outliers import check_static_ends
from gsparc.data.schema import LIGHT, OTHER, Measurements, Site, StaticEnds
from gsparc.data.selection import WHOLE, Selection
from gsparc.data.target import TARGETS
from gsparc.data.units import LINEAR, PowerUnit
from gsparc.tables.checks.constant import leave_out_unmeasured, mark_constants
from gsparc.tables.conventions import convert_conventions
from gsparc.tables.links.expand import expand_links
from gsparc.tables.other_names import amplitudes_to_levels, name_arrays
from gsparc.tables.own_checks import Checker, are_infinite, rows_with
from gsparc.tables.own_values import read_directions, read_measured, read_not_negative, scale_values
from gsparc.tables.raw import Raw, read_raw, write_raw

log = logging.getLogger(__name__)

SSIM_WINDOW = 11  # pixels along each side; as in losses and metrics, which data do not import
Arrays = Mapping[str, np.ndarray]
# Of `Measurements`, as `expand_links` leaves them
OF_ROWS = ("station", "place", "censored", "run")
OWN_ATTRIBUTES = ("name", "measurement", "normalisation", "stand_in", "convergence_error")


@dataclass(frozen=True)
class Reading:
    """Measurements read from a file, and notes.

    Attributes:
        data: the measurements.
        notes: remarks for the user, one line each; nothing is wrong.
        file_row: (S,) number of each row in its file from 0, as `dataset.level_steps` counts; None:
            its own.
        raw: what the file holds, where a file was read.
    """

    data: Measurements
    notes: tuple[str, ...]
    file_row: np.ndarray | None = None
    raw: Raw | None = None


def load_own(path: str | Path) -> Measurements:
    """Read a file of the schema; notes are logged.

    Raises:
        DataError: anything is missing or wrong; all problems are listed with array and row.
    """
    return interpret_and_log(read_raw(path), path)


def interpret_and_log(raw: Raw, source: str | Path) -> Measurements:
    """Return the measurements of `interpret`; notes are logged."""
    reading = interpret(raw, source)
    for note in reading.notes:
        log.warning("%s: %s", source, note)
    return reading.data


def write_own(
    path: str | Path, arrays: Arrays, attributes: Mapping[str, Any] | None = None
) -> Measurements:
    """Write arrays named as in the schema (validated first, atomically)
    and return them as measurements.

    Args:
        path: *.npz, *.h5 or *.hdf5.
        arrays: by name, in the schema's units.
        attributes: `name`, `normalisation`, `stand_in`, `convergence_error`, and any provenance.

    Raises:
        DataError: what `load_own` would refuse.
    """
    contents = {name: np.asarray(array) for name, array in arrays.items()}
    units = {
        name: FIELDS[name].unit for name in contents if name in FIELDS and FIELDS[name].unit != "1"
    }
    raw = Raw(contents, dict(attributes or {}), units)
    data = interpret(raw, path).data
    write_raw(path, raw)
    return data


def from_arrays(arrays: Arrays, attributes: Mapping[str, Any] | None = None) -> Measurements:
    """Validate arrays as `write_own` does, without a file.

    Raises:
        DataError: what `load_own` would refuse.
    """
    raw = Raw({name: np.asarray(array) for name, array in arrays.items()}, dict(attributes or {}))
    return interpret(raw, "arrays").data


def interpret(raw: Raw, source: str | Path, part: Selection = WHOLE) -> Reading:
    """Validate `raw` and centre, scale and hash it.

    CSI is divided by its root mean square over all measured entries, RSSI by its mean power;
    spectra of floating point are divided by their largest value unless it lies between 0.1 and 1.
    The constant is one per site, rounded to whole decibels, and kept as `site.target_scale`:
    metrics multiply it back.

    Args:
        raw: named as in docs/reference/schema.md.
        source: for messages.
        part: of the campaign that is used.

    Raises:
        DataError: all problems, with array and row.
    """
    check = Checker(amplitudes_to_levels(name_arrays(raw)), str(source))
    check.check_names()
    measured = check.measurement()
    # Lists add one of their own
    stated = {name: "stated" for name in raw.arrays if name == "sensitivity_db"}
    about = _attributes(check, Path(source).stem, measured)
    links = None if measured is None else expand_links(check, measured, part)
    # Without a measurement no array has a length to be checked against: nothing more can be said.
    if measured is None or links is None:
        check.problems.raise_if_any()
    assert measured is not None and links is not None
    raw = check.raw
    # Only places that the file leaves open may be NaN; `check.position` refuses all others.
    has_unknown = links.stations is not None and np.isnan(links.stations.position).any()
    has_unknown |= links.unknown_transmitter
    check.unknown = f"{links.static_end}_position" if has_unknown else None
    values, kind = read_measured(check, measured)
    if values is None:
        # Positions are checked all the same, so that one message lists everything that is wrong.
        for name in ("rx_position", "tx_position"):
            check.read_positions(name, None)
        check.problems.raise_if_any()
    assert values is not None
    rows, facts = len(values), TARGETS[kind]
    of_rows = {name: raw.arrays.get(name) for name in OF_ROWS}
    row_names = check.name_rows(rows, links.stations)
    ends = {end: check.read_positions(f"{end}_position", rows) for end in ("rx", "tx")}
    rotation = check.read_rotation(rows)
    given_mask = check.read_mask(raw.arrays[measured].shape, of_rows["censored"])
    mask = None if given_mask is None else given_mask.reshape(values.shape)
    named = str(raw.attributes.get("conventions", "")).split()
    if facts.is_complex and check.fits_exchanged(*values.shape[1:]):
        if "exchange_axes" not in named:
            fits = (
                f"rows of shape {values.shape[1:]} fit frequencies and antennas with their "
                "axes exchanged"
            )
            check.refuse("csi", f"{fits}; say dataset.exchange_axes=true")
        named = [name for name in named if name != "exchange_axes"]  # it is done here
        values, mask = values.swapaxes(1, 2), None if mask is None else mask.swapaxes(1, 2)
    frequency, carrier = check.read_frequencies(values.shape[2] if facts.is_complex else None)
    # Transposed images: their grid is that of the axes as they will be.
    turned = values.shape[:0:-1] if "transposed" in named else values.shape[1:]
    grid = check.read_grid(*turned) if facts.is_image else None
    antennas = values.shape[1] if facts.is_complex and values.shape[1] > 1 else None
    array = check.read_real("array_position", (antennas, 3))
    if array is not None:
        antenna = [f"antenna {i}" for i in range(len(array))]
        check_positions(check.problems, check.describe_array("array_position"), array, antenna)
    noise = read_not_negative(check, "noise_variance", rows)
    # Decibels have no additive noise variance: it belongs to linear powers.
    if noise is not None and measured == "rssi_db":
        check.refuse("noise_variance", "cannot go with rssi_db; expected rssi (linear)")
    position_std = read_not_negative(check, "position_std", rows)
    about["device_names"], devices = check.read_devices(rows, kind)
    offsets = check.read_ragged(rows)
    release_split = check.read_split(rows)
    check.check_range(measured, values, mask)
    if all(end is not None for end in (*ends.values(), rotation)):
        _static(check, links, ends, rotation)
    check.problems.raise_if_any()
    assert rotation is not None
    # Copies, as broadcast views are read-only.
    rx, tx = (np.broadcast_to(np.asarray(ends[end]), (rows, 3)).copy() for end in ("rx", "tx"))
    directions = read_directions(check, offsets, rx, rotation)
    if facts.is_image and min(values.shape[1:]) < SSIM_WINDOW:
        check.notes.append(
            f"images of {values.shape[1]} x {values.shape[2]} pixels are smaller than SSIM's "
            "window of "
            f"{SSIM_WINDOW} x {SSIM_WINDOW}: losses are L1 alone, ssim_gauss is undefined"
        )
    site = Site(
        kind=kind,
        static_end=links.static_end,
        grid=grid,
        array=array,
        carrier_hz=carrier,
        subcarriers_hz=frequency if facts.is_complex else None,
        stations=links.stations,
        georeference=links.georeference,
        **about,
    )
    provenance = {
        str(k): str(v) for k, v in raw.attributes.items() if k not in OWN_ATTRIBUTES
    } | stated
    data = Measurements(
        site,
        tx,
        rx,
        rotation,
        values,
        mask,
        noise,
        directions,
        row_names,
        release_split,
        provenance,
        position_std=position_std,
        device=devices,
        sequence=check.read_sequence(rows, kind),
        **of_rows,
    )
    data = mark_constants(data, check.notes)
    # Conventions turn values before they are scaled: the scale is that of what is stored.
    data = leave_out_unmeasured(convert_conventions(data, named))
    if facts.is_complex:
        _note_plane(check, tx if links.static_end == "rx" else rx, carrier)
    target, scale = scale_values(measured, data.target, data.mask, data.censored)
    # A damaged row of 1e300 overflows float32 once it is divided by the others' scale: it is named.
    if scale > 0:
        huge = "beyond float32 in units of the other rows; is it damaged?"
        check.refuse_rows(measured, rows_with(target, are_infinite), huge)
    if not (np.isfinite(scale) and scale > 0):
        check.refuse(measured, "every measured value is zero; expected some signal")
    check.problems.raise_if_any()
    # Variances scale with the square of the amplitude that was divided out.
    # `**` may overflow
    noise = None if noise is None else (noise / (scale * scale)).astype(np.float32)
    site = replace(data.site, target_scale=scale)
    data = centre_and_hash(replace(data, site=site, target=target, noise_variance=noise))
    file_row = raw.arrays["file_row"]
    return Reading(data, (*check.notes, *raw.explain(data, file_row)), file_row)


def _attributes(check: Checker, stem: str, measured: str | None) -> dict[str, Any]:
    """Facts of the site that come from the file's attributes."""
    attributes = check.raw.attributes
    normalisation = str(attributes.get("normalisation", "none"))
    if normalisation not in NORMALISATIONS:
        check.refuse(
            "normalisation", f"{normalisation!r}; expected one of {', '.join(NORMALISATIONS)}"
        )
    error, stand_in = attributes.get("convergence_error"), attributes.get("stand_in")
    if not or_null(number(0)).holds(error):
        error = check.refuse(
            "convergence_error", f"{error!r}; expected a finite number, at least 0"
        )
    for name in ("name", "stand_in"):
        if not isinstance(attributes.get(name), str | None):
            check.refuse(name, f"a {type(attributes[name]).__name__}; expected text")
    # Linear powers are watts if the file says nothing, levels are dB of an unknown reference.
    level_unit, unit = (
        str(attributes.get("level_unit", "dBW" if measured == "rssi" else "dB")),
        None,
    )
    if measured in ("rssi", "rssi_db"):
        linear = "W" if level_unit == "dBW" else LINEAR
        unit = attributes.get("unit", linear if measured == "rssi" else None)
    try:
        PowerUnit.from_name(unit, level_unit)
    except ValueError as fault:
        check.refuse("unit", str(fault))
    return {
        **{"level_unit": level_unit, "unit": unit},
        "name": str(attributes.get("name") or stem),
        "normalisation": normalisation,
        "stand_in": None if stand_in is None else str(stand_in),
        "convergence_error": None if error is None else float(error),
    }


def _static(check: Checker, links: StaticEnds, ends: Mapping[str, Any], rotation: Any) -> None:
    """Refuse ends of which neither moves, a static receiver that turns,
    and static ends far from all rows.
    """
    several, fault = links.stations is not None, ""
    if not several and all((p == np.atleast_2d(p)[:1]).all() for p in ends.values()):
        fault = "neither end moves; expected (S, 3) positions for one of them"
    elif not several and links.static_end == "rx" and (rotation != rotation[0]).any():
        fault = (
            "the receiver stands still but turns while the transmitter moves; expected one "
            "orientation"
        )
    if fault:
        check.problems.add(check.source, fault)
    if links.static_end is None:
        return
    still, moving = ends[links.static_end], ends[OTHER[links.static_end]]
    if moving.ndim < 2 or not np.isfinite(still).any():
        return
    fault, certain = check_static_ends(
        np.unique(np.atleast_2d(still), axis=0), moving, links.georeference
    )
    if fault and certain:
        check.problems.add(check.source, fault)
    elif fault:
        check.notes.append(Caution(fault))


def _note_plane(check: Checker, moving: np.ndarray, carrier_hz: float | None) -> None:
    """Note positions in one plane: a source and its mirror image in it are indistinguishable."""
    if carrier_hz is None:
        return
    # Square root of the least eigenvalue: the spread along the normal of the best plane [m].
    thickness = float(np.sqrt(np.linalg.eigvalsh(np.cov(moving.T))[0].clip(0)))
    wavelength = LIGHT / carrier_hz
    # Twice a quarter wavelength: paths of a source and of its mirror image differ by half a wave.
    if thickness < wavelength / 4:
        check.notes.append(
            f"the positions spread only {thickness:.2g} m ({thickness / wavelength:.2g} "
            "wavelengths) about a "
            "plane: a source and its mirror image in it look the same; several heights tell them "
            "apart"
        )
