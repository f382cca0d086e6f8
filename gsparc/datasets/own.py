"""Measurements of one's own, `dataset=own`, and whatever file or folder `gsparc check` is given."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsparc.base.errors import DataError, Question
from gsparc.base.instantiate import from_settings
from gsparc.base.limits import finite_array, or_null, switch
from gsparc.data.schema import Measurements
from gsparc.data.selection import Selection, pop_selection
from gsparc.datasets.ble import BLE
from gsparc.datasets.campaign import Campaign
from gsparc.datasets.cbrs import Cbrs
from gsparc.datasets.newrf import NeWRF
from gsparc.datasets.powder import Powder
from gsparc.datasets.rfid import load_rfid
from gsparc.datasets.techtile import Techtile
from gsparc.datasets.techtile_power import TechtilePower
from gsparc.datasets.wifi_csi import WifiCsi
from gsparc.datasets.wsr import WSR
from gsparc.tables import is_table
from gsparc.tables.conventions import CONVENTIONS
from gsparc.tables.own import Reading, interpret
from gsparc.tables.raw import Raw, read_raw

log = logging.getLogger(__name__)


def read_own(
    path: str | Path,
    columns: Mapping[str, object] | None = None,
    stations_file: str | Path | None = None,
    guess: bool = False,
    columns_file: str | Path | None = None,
    **settings: Any,
) -> Raw:
    """Read a file of docs/reference/schema.md, or a table under the schema's names.

    Args:
        path: *.npz, *.h5 or *.hdf5, or a table: *.csv, *.tsv, *.txt or *.parquet.
        columns: of a table, by quantity, where the guess from their heads will not do.
        stations_file: of a table, a second one that lists the stations.
        guess: whether the likeliest reading of what is open is taken.
        columns_file: of a table, that says what its columns are.
        **settings: see `apply_settings`.

    Raises:
        DataError: bad input, or a file of another campaign.
        SettingError: see `apply_settings`.
    """
    raw = apply_settings(
        read_file_or_table(path, columns, stations_file, guess, columns_file), **settings
    )
    campaign = dataset_by_arrays(raw)
    if campaign is not None:
        raise DataError(
            f"{path}: this is a file of dataset={campaign.choice}; say dataset={campaign.choice}"
        )
    return raw


def apply_settings(
    raw: Raw,
    not_heard: Sequence[float] | None = None,
    absent: str = "auto",
    saturation_db: float | str = "auto",
    tx_position: Sequence[float] | None = None,
    frequency_hz: float | Sequence[float] | None = None,
    carrier_hz: float | None = None,
    spacing_hz: float | None = None,
    **conventions: bool | None,
) -> Raw:
    """Return the same with what settings say of the file.

    Args:
        raw: as it was read.
        not_heard: levels that mean that nothing was heard; None: those that stand apart from all
            others.
        absent: `silent`: a station without a level at a place where others have one was not heard
            there; `weaker`: one that a list of the strongest leaves out is below its weakest,
            levels that are missing beside weak ones alone are below their station's; `auto`: the
            same, but the last is asked where no row names the pair; `unknown`: neither.
        saturation_db: level [dB] from which on powers are at least that; `auto`: the highest where
            it repeats; `none`: there is none.
        tx_position: of a transmitter that stood still, where the file does not say it [m].
        frequency_hz: of the tones, likewise [Hz].
        carrier_hz, spacing_hz: of tones, the middle one and from one to the next, instead [Hz].
        **conventions: those of `CONVENTIONS` that the file follows instead of the schema's.

    Raises:
        SettingError: another word for a convention.
    """
    settings = {"not_heard": not_heard, "absent": absent, "saturation_db": saturation_db}
    facts: dict[str, Any] = {
        name: value for name, value in settings.items() if value not in (None, "auto")
    }
    for name, follows in conventions.items():
        or_null(switch()).check(f"dataset.{name}", follows)
    followed = [name for name, follows in conventions.items() if follows]
    facts |= {"conventions": " ".join(followed)} if followed else {}
    values = {"tx_position": tx_position, "frequency_hz": frequency_hz}
    values |= {"carrier_hz": carrier_hz, "spacing_hz": spacing_hz}
    arrays = {name: finite_array(value) for name, value in values.items() if value is not None}
    return replace(raw, arrays={**raw.arrays, **arrays}, attributes={**raw.attributes, **facts})


class Own(Campaign):
    """Measurements of one's own; suspicious units are warned of.
    Settings of `read_own` and `Campaign`.
    """

    choice, reader = "own", staticmethod(read_own)
    # Arguments of `apply_settings` but its data and its conventions, which are listed by name.
    switches = tuple(inspect.signature(apply_settings).parameters)[1:-1] + tuple(CONVENTIONS)

    def raw(self) -> Raw:
        """Read the file; answers to its questions are kept."""
        raw = super().raw()
        self.said = raw.said
        for role in [role for role in raw.roles if role.readings]:
            log.warning("dataset.guess=true takes %s", role.readings[0])
        return raw

    def load(self) -> Measurements:
        """Read, and stop where readings differ that nothing decides,
        unless training was answered.
        """
        data = super().load()
        questions = [note for note in self.notes if isinstance(note, Question)]
        if questions and not (self.settings.get("guess") or self.told):
            raise DataError([f"{self.file}: {question}" for question in questions], self.file)
        return data


TABLE = ("columns", "stations_file", "guess", "columns_file")  # settings of tables
CAMPAIGNS: tuple[type[Campaign], ...] = (
    *(Techtile, Powder, BLE, NeWRF, TechtilePower, WSR, WifiCsi, Cbrs),
)


def dataset_by_arrays(raw: Raw) -> type[Campaign] | None:
    """Return the campaign that a file with these arrays is of; None: of none of them."""
    # By its arrays rather than its name: files are renamed, arrays are not.
    return next(
        (
            campaign
            for campaign in CAMPAIGNS
            if campaign.marks and campaign.marks <= set(raw.arrays)
        ),
        None,
    )


def dataset_by_path(path: Path) -> type[Campaign] | None:
    """Return the campaign that a release, file or folder, is of; None: of none of them."""
    for campaign in CAMPAIGNS:
        inside = campaign.inside and path.is_dir() and any(path.glob(campaign.inside))
        if inside or path.suffix.lower() in campaign.suffixes:
            return campaign
    return None


def read_any(path: str | Path, **settings: Any) -> Reading:
    """Read a folder or file of a release, a file of another campaign, one of one's own, or a table.

    Args:
        path: folder or file.
        **settings: of `read_own` and of `Selection`.

    Raises:
        DataError: it is none of them, or something in it is wrong.
    """
    path = Path(path)
    part = from_settings(Selection, pop_selection(settings), "dataset")
    table = {name: settings.pop(name, None) for name in TABLE}
    # Releases before anything else: their folders may hold tables that look like one's own.
    release = dataset_by_path(path)
    if release is not None:
        raw, note = release.reader(path), f"this is the release of dataset={release.choice}"
    elif path.is_dir():
        if not any(
            (path / name).exists() for name in ("gateway_info.yml", "tx_pos.csv", "spectrum")
        ):
            raise DataError(
                f"{path}: a folder without gateway_info.yml, tx_pos.csv and spectrum/ (the RFID "
                "release's "
                "layout); for measurements of your own give the npz or HDF5 file"
            )
        return Reading(load_rfid(path), ())
    else:
        raw, note = read_file_or_table(path, **table), ""
        if (campaign := dataset_by_arrays(raw)) is not None:
            raw, note = campaign.reader(path), f"this is a file of dataset={campaign.choice}"
    raw = replace(raw, notes=(*filter(None, [note]), *raw.notes))
    questions = [note for note in raw.notes if isinstance(note, Question)]
    try:
        return replace(interpret(apply_settings(raw, **settings), path, part), raw=raw)
    except DataError as error:
        asked = [f"{path}: {question}" for question in questions]
        raise DataError([*asked, *error.problems], path) from None


def read_file_or_table(
    path: str | Path,
    columns: Mapping[str, object] | None = None,
    stations_file: str | Path | None = None,
    guess: bool | None = False,
    columns_file: str | Path | None = None,
) -> Raw:
    """Read the arrays of a file of the schema, or of a table;
    notes say how its columns were understood.

    Raises:
        DataError: not readable, or columns that nothing can be made of.
    """
    if not is_table(path):
        named = any(value is not None for value in (columns or {}).values())
        given = zip(TABLE, (named, stations_file, False, columns_file), strict=True)
        for name in [name for name, entry in given if entry]:
            raise DataError(f"dataset.{name}: goes with tables (*.csv, *.parquet), not with {path}")
        return read_raw(path)
    from gsparc.tables.read import parse_table  # here, as pandas takes half a second to import

    return parse_table(path, columns or {}, stations_file, (), bool(guess), columns_file)
