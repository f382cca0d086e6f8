"""What campaigns and releases share: arrays are checked, a part is selected,
a stand-in takes their place.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from gsparc.base.errors import Caution, DataError, Problems, Severe
from gsparc.base.files import read_shipped_table, read_text
from gsparc.base.limits import SettingError
from gsparc.data.assemble import check_positions
from gsparc.data.fields import Field
from gsparc.data.foreign import foreign_warnings
from gsparc.data.schema import Measurements, TrainTest
from gsparc.data.selection import Selection, pop_selection
from gsparc.datasets.datamodule import DataModule
from gsparc.datasets.public.fetch import fetched_path, fetched_path_or_none
from gsparc.tables.advice import run_warnings
from gsparc.tables.arrays import Raw, name_rows_by_number, rename_arrays
from gsparc.tables.checks.conventions import convention_warnings
from gsparc.tables.checks.level_steps import LevelStep, LinkLevels, find_level_steps, link_levels
from gsparc.tables.checks.plausibility import sanity_warnings, unit_warnings
from gsparc.tables.own import interpret
from gsparc.tables.own_checks import Checker
from gsparc.tables.raw import read_raw

log = logging.getLogger(__name__)


class Campaign(DataModule):
    """A published campaign with stations, of which all rows or a part are used.

    Args:
        file: what `raw` reads; None: what `gsparc data` fetched.
        name, batch_size: see `DataModule`; None: the name of the choice of conf/dataset.
        **settings: of `gsparc.data.selection.Selection`, and what `reader` takes besides.
    """

    choice: ClassVar[str]  # of conf/dataset
    marks: ClassVar[frozenset[str]] = frozenset()  # arrays that an npz of it has, and of no other
    suffixes: ClassVar[tuple[str, ...]] = ()  # of files of the release
    inside: ClassVar[str] = ""  # pattern of a file that folders of the release hold
    switches: ClassVar[tuple[str, ...]] = ()  # settings that `reader` takes besides its arguments
    hands_on = Selection  # whose settings it takes
    # The arrays of a file, named as in docs/reference/schema.md
    reader: ClassVar[Callable[..., Raw]]

    def __init__(
        self,
        file: str | Path | None = None,
        name: str | None = None,
        batch_size: int = 16,
        **settings: Any,
    ) -> None:
        super().__init__(name or self.choice, batch_size)
        file = fetched_path(self.choice) if file in (None, "", "???") else file
        if not isinstance(file, str | Path):
            raise SettingError(
                f"dataset.file={[*map(str, file)]}: expected one file; join tables first"
            )
        self.file = Path(file)
        self.settings, self.selection = settings, Selection(**pop_selection(settings))

    def raw(self) -> Raw:
        """Read the file's arrays, named as in docs/reference/schema.md;
        `DataError` where they are bad.
        """
        return self.reader(self.file, **self.settings)

    def load(self) -> Measurements:
        """Read, select and interpret; what is left out and what looks wrong is logged."""
        reading = interpret(self.raw(), self.file, self.selection)
        self.notes = reading.notes
        warnings, _, _ = find_implausible(reading.data, reading.file_row)
        warnings += [note for note in reading.notes if isinstance(note, Caution)]
        for note in reading.notes:
            if not isinstance(note, Caution) and note not in self.told:
                log.info("%s: %s", self.file, note)
        for warning in sorted(warnings, key=lambda text: not isinstance(text, Severe)):
            log.warning("%s: %s", self.file, warning)
        return reading.data


MOST_LINKS = 1_000_000  # of places and stations; all are held at once


def find_implausible(
    data: Measurements, file_row: np.ndarray | None, most: float = MOST_LINKS
) -> tuple[list[str], LinkLevels | None, list[tuple[int, LevelStep]]]:
    """Return warnings of units, conventions and levels, and the levels and their steps,
    of `most` links.
    """
    hints: list[str] = [Severe(f"units? {hint}") for hint in unit_warnings(data)]
    places = len(data) if data.place is None else len(np.unique(data.place))
    if places * len(data.site.every_station) > most:
        note = "too many links to be looked at for implausible levels here; gsparc check does"
        return [*hints, note], None, []
    hints += map(Severe, convention_warnings(data))
    hints += foreign_warnings(data)
    if (levels := link_levels(data, file_row)) is None:
        return hints, None, []
    steps, hints = find_level_steps(levels), [*hints, *run_warnings(data)]
    return [*hints, *sanity_warnings(levels, steps)], levels, steps


class StandIn(Protocol):
    """Simulated measurements in a release's layout,
    handed to the release's module by the configuration.
    """

    def folder(self) -> Path:
        """Return where they are; simulated when they are not there yet.

        Raises:
            ValueError: settings that cannot be simulated.
        """


class Release(DataModule):
    """A folder of a published release: one that is named, the fetched one,
    or what stands in for it.

    Args:
        root: the folder; None: what `gsparc data` fetched of it, where it did.
        stand_in: used, loudly, when there is neither.
        name, batch_size: see `DataModule`.
        **settings: what `reader` takes besides.
    """

    called = ""  # the release, in messages; in small letters the choice of conf/dataset
    hint = ""  # how to get it
    reader: ClassVar[Callable[..., Measurements]]  # what a folder holds

    def __init__(
        self,
        root: str | Path | None = None,
        name: str | None = None,
        stand_in: StandIn | None = None,
        batch_size: int = 16,
        **settings: Any,
    ) -> None:
        super().__init__(name or self.called.lower(), batch_size)
        self.root = fetched_path_or_none(self.called.lower()) if root is None else Path(root)
        self.stand_in, self.settings = stand_in, settings

    def missing(self) -> str:
        """Say why the release is not used, and how to get it."""
        root = (
            f"dataset.root={self.root} does not exist" if self.root else ("dataset.root is not set")
        )
        return (
            f"{root}: the {self.called} release is NOT on disk. {self.hint}, then set "
            "dataset.root=FOLDER."
        )

    def read(self, folder: Path) -> Measurements:
        """Read a folder in the release's layout;
        `DataError` where something is missing or wrong.
        """
        return self.reader(folder, **self.settings)

    def load(self) -> Measurements:
        """Load the release's measurements, or, loudly, the stand-in's."""
        if self.root is not None and self.root.exists():
            return self.read(self.root)
        if self.root is not None or self.stand_in is None:
            raise DataError(self.missing())
        log.warning("%s Using its SIMULATED stand-in instead.", Severe(self.missing()))
        return load_stand_in(self.stand_in, self.called, self.read)


def load_stand_in(
    stand_in: StandIn, called: str, read: Callable[[Path], Measurements]
) -> Measurements:
    """Return the measurements of what stands in for the release `called`."""
    folder = stand_in.folder()
    layout = f"{called.lower()}-sim: SIMULATED data in the layout of the {called} release"
    log.warning("%s, at %s", layout, folder)
    return read(folder)


def make_once(folder: Path, write: Callable[[Path], None]) -> Path:
    """Return the folder, written when it is not there yet."""
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        write(folder)
    return folder


def write_split(folder: Path, count: int, seed: int, first: int = 0, form: str = "%d") -> None:
    """Write rows' numbers from `first` on, a random fifth of them for testing,
    in a text file each.
    """
    order, test = np.random.default_rng(seed).permutation(count) + first, max(round(0.2 * count), 1)
    for name, rows in (("test", order[:test]), ("train", order[test:])):
        np.savetxt(folder / f"{name}_index.txt", np.sort(rows), fmt=form)


def read_split(
    folder: Path, count: int | None, problems: Problems, first: int = 0
) -> TrainTest | None:
    """Read (train, test) rows from 0, out of `train_index.txt` and `test_index.txt`;
    None without them.

    Args:
        folder: of the release.
        count: number of rows; None: unknown.
        problems: takes what is wrong.
        first: number of the first row in the files.
    """
    paths = [folder / "train_index.txt", folder / "test_index.txt"]
    present = [path for path in paths if path.exists()]
    if not present:
        return None
    for absent in {*paths} - {*present}:
        return problems.add(
            absent, f"missing, but {present[0].name} is there; expected both or none"
        )
    train, test = (_read_index(path, count, problems, first) for path in paths)
    if train is None or test is None:
        return None
    both = np.intersect1d(train, test)
    problems.add_rows(paths[1], (f"index {i + first:05d}" for i in both), "also in train_index.txt")
    return train, test


def _read_index(path: Path, count: int | None, problems: Problems, first: int) -> np.ndarray | None:
    """Rows (n,) from 0, sorted."""
    lines = (problems.attempt(lambda: read_text(path, "missing")) or "").split("\n")
    words = [
        (n, word.removesuffix(".png")) for n, line in enumerate(lines, 1) for word in line.split()
    ]
    plain = [word if re.fullmatch(f"[0-9]{{1,{LONGEST}}}", word) else "-1" for _, word in words]
    rows = np.array(plain, np.int64) - first
    wrong = (rows < 0) | (rows >= (np.inf if count is None else count))
    again = ~np.isin(np.arange(len(rows)), np.unique(rows, return_index=True)[1]) & ~wrong
    expected = f"expected the number of a row like {first:05d}"
    expected += "" if count is None else f", at most {first + count - 1}"
    for bad, fault in ((wrong, expected), (again, "named before")):
        named = (f"line {words[i][0]}: {words[i][1][:LONGEST]!r}" for i in np.flatnonzero(bad))
        problems.add_rows(path, named, fault)
    if not words and path.is_file():
        return problems.add(path, "no usable index in it; expected one number of a row per line")
    return np.sort(rows) if words and not wrong.any() else None


LONGEST = 18  # digits of an index


def read_layout(layout: str) -> list[Field]:
    """Return the arrays of a layout of layouts.csv."""
    rows = read_shipped_table(__package__, "layouts.csv")
    return [Field(**row) for row in rows if row.pop("layout") == layout]


def check_layout(
    raw: Raw, source: str | Path, layout: str, places: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return arrays of a layout; the first array with a letter sets its size.

    Args:
        raw, source: the arrays, and their file.
        layout: see `read_layout`.
        places: arrays of coordinates [m], all of which must be finite and on Earth.

    Raises:
        DataError: all that is missing, of another shape or type, or no place, with array and row.
    """
    check, fields = Checker(raw, str(source)), {field.name: field for field in read_layout(layout)}
    for name, field in fields.items():
        array = check.read_array(name, *field.shapes, holds=field.holds)
        if array is not None:
            shape = next(shape for shape in field.shapes if len(shape) == array.ndim)
            letters = zip(shape, array.shape, strict=True)
            check.sizes |= {letter: size for letter, size in letters if isinstance(letter, str)}
            if name in places:
                rows = [*name_rows_by_number(len(array))]
                check_positions(check.problems, check.describe_array(name), array, rows)
        elif name not in raw.arrays and field.required == "yes":
            check.refuse(name, f"missing; expected {field.holds} {field.shape}")
    check.problems.raise_if_any()
    return {name: raw.arrays[name] for name in fields if name in raw.arrays}


def read_converted(path: str | Path, of: str, **about: str) -> Raw:
    """Read arrays of an npz that was made of a release, by field of the schema.

    Args:
        path: of the file.
        of: the layout in layouts.csv, with names of the schema.
        **about: attributes.

    Raises:
        DataError: no such file, or some of the arrays are not in it.
    """
    raw, fields = read_raw(path), {field.name: field.becomes for field in read_layout(of)}
    missing = [f"{path}, {name}: missing" for name in fields if name not in raw.arrays]
    if missing:
        raise DataError(missing, path)
    listed = {name: raw.arrays[name] for name in fields}
    return rename_arrays(
        replace(raw, arrays=listed, attributes={**raw.attributes, **about}), fields
    )
