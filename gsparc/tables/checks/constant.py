"""What is constant over rows but for rounding: guard tones, dead antennas, stuck stations.

Tones and antennas of channels are left out, as what a receiver fills in may be far stronger than
what it measures, and would be most of every figure. A station may be as it says: it is named
alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.base.errors import Caution, list_first, name_row_ranges
from gsparc.data.blocks import is_big, row_blocks, rows_by, write_blocks
from gsparc.data.schema import Measurements

LEAST = 8  # rows, at places of their own
ROUNDING = 1e-4  # of an entry: four digits of a table
NOTHING = 1e-6  # of the median entry, what a transform leaves of 0


def mark_constants(data: Measurements, notes: list[str]) -> Measurements:
    """Return channels with what is constant over rows marked as not measured;
    `notes` that name it are added.

    Rows of spectra and powers that are all the same are named alone.
    Values are those of the file, before they are scaled.
    """
    facts, shape = data.site.target, data.target.shape[1:]
    if len(np.unique(data.moving[: 20 * LEAST], axis=0)) < LEAST:
        return data
    together = is_big(data.target) or not data.site.several
    labels = np.zeros(len(data), np.int64) if together else data.stations_of()
    heard = data.censored_side() == 0
    constant = {
        t: _constant_of(data, rows) for t, rows in rows_by(labels) if heard[rows].sum() >= LEAST
    }
    stuck = [t for t, entries in constant.items() if entries.all()]
    names = [data.site.every_station.shown[t] for t in stuck]
    if stuck:
        who = (
            f"of station{'s' if len(names) > 1 else ''} {list_first(names)} "
            if data.site.several
            else ""
        )
        notes += [Caution(f"all rows {who}are the same: are they measurements?")]
    alive = [entries for t, entries in constant.items() if t not in stuck]
    common = np.asarray(np.array(alive or [np.zeros(shape)]).all(axis=0))
    if not common.any() or not facts.is_complex:
        return data
    antennas = np.asarray(common.all(axis=1))
    tones = np.asarray(common[~antennas].all(axis=0))
    which = [f"antenna {number}" for number in np.flatnonzero(antennas)]
    which += [f"tone {number}" for number in np.flatnonzero(tones)]
    which += [f"antenna {i} tone {k}" for i, k in np.argwhere(common & ~antennas[:, None] & ~tones)]
    inputs = (
        f"{name_row_ranges(which, count=LEAST)} (of {shape[0]} x {shape[1]}, from 0) are constant"
    )
    fault = (
        f"{inputs} over all rows: guards, nulls or a dead input? left out of learning and of "
        "all figures"
    )
    measured = np.broadcast_to(~common, data.target.shape)
    mask = measured if data.mask is None else measured & data.mask
    notes.append(Caution(fault))
    return replace(data, mask=mask)


def leave_out_unmeasured(data: Measurements) -> Measurements:
    """Return channels of the antennas and tones that any row measured;
    `Site.measured` says which.
    """
    if not data.site.target.is_complex or data.mask is None:
        return data
    antennas, tones = data.target.shape[1:]
    known = np.zeros((antennas, tones), bool)
    for part in row_blocks(data.mask):
        known |= data.mask[part].any(0)
    rows, columns = np.flatnonzero(known.any(1)), np.flatnonzero(known.any(0))
    measured = np.zeros((antennas, tones), bool)
    measured[np.ix_(rows, columns)] = True
    if measured.all() or not measured.any():
        return data
    site, kept = data.site, dict[str, np.ndarray]()
    if site.subcarriers_hz is not None and len(site.subcarriers_hz) == tones:
        kept["subcarriers_hz"] = site.subcarriers_hz[columns]
    for name, of in (("array", site.array), ("antennas", site.antennas)):
        kept |= {name: of[rows]} if of is not None and len(of) == antennas else {}
    site = replace(site, **kept, measured=measured)  # type: ignore[arg-type]
    mask = data.mask[:, rows][:, :, columns]
    shape, large = (len(data), rows.size, columns.size), is_big(data.target)

    def take(part: slice) -> np.ndarray:
        values: np.ndarray = data.target[part]
        return values[:, rows][:, :, columns]

    target = write_blocks(shape, data.target.dtype, take) if large else take(slice(None))
    return replace(data, site=site, target=target, mask=None if mask.all() else mask)


def _constant_of(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Tell which entries (...) have one value wherever rows (n,) measured them,
    but for rounding.
    """
    whole = len(rows) == len(data)
    values = data.target if whole else data.target[rows]
    mask = data.mask if data.mask is None or whole else data.mask[rows]
    ends = np.full((2, *values.shape[1:], 2), np.inf)  # lowest, and highest with its sign changed
    for part in row_blocks(values):
        block = np.stack([values[part].real, values[part].imag], -1).astype(np.float64)
        measured = True if mask is None else mask[part][..., None]
        for end, sign in zip(ends, (1, -1), strict=True):
            np.minimum(end, np.where(measured, sign * block, np.inf).min(0), out=end)
    low, high = ends[0], -ends[1]
    known = np.isfinite(low).all(-1)
    if not known.any():
        return known
    low, high = np.where(known[..., None], low, 0), np.where(known[..., None], high, 0)
    spread, size = (high - low).max(-1), np.maximum(np.abs(low), np.abs(high)).max(-1)
    result: np.ndarray = known & (
        spread <= ROUNDING * size + NOTHING * float(np.median(size[known]))
    )
    return result
