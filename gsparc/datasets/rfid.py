"""The RFID release's layout (NeRF2, set s23): one spectrum image per tag position, static gateway.

gateway_info.yml     dataset_name, then per gateway: position [m], orientation (x, y, z, w)
tx_pos.csv           header x,y,z; row i (from 1) belongs to spectrum/%05d.png of i [m]
spectrum/00001.png   8-bit grey, 360 wide (azimuth, degrees) x 90 high (elevation, row 0 = 0
degrees) train_index.txt, test_index.txt   optional, both or none: one number per line
freq.txt             optional: line i is the carrier of spectrum i [GHz]

With freq.txt it is the layout of Wideband3DGS and XFreq-GS: each carrier is a station of its own at
the gateway, with an array half a wavelength apart in the receiver's yz plane; row i of an image is
the zenith angle of i degrees, and azimuths run clockwise. Their spectra say so: all but .0003 of
their energy is in the lags of that array (elevations, or the plane xy, leave .05 at least),
and direct paths appear mirrored.

GSpaRC's room has the same with `rx_pos.csv`: the gateway is the transmitter that stands, the
receiver moves and its axes are the world's. Its spectra are `00001.npy`: (90, 360)
real numbers from 0 to 1, or of 8 bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from gsparc.base.errors import DataError, Problems, readable
from gsparc.base.files import read_text, read_yaml
from gsparc.base.limits import finite_array, parse_numbers
from gsparc.data.assemble import centre_and_hash, check_positions
from gsparc.data.blocks import allocate
from gsparc.data.schema import LIGHT, End, Measurements, Site, Stations, TrainTest
from gsparc.data.spacing import number_places
from gsparc.datasets.campaign import Release, read_split
from gsparc.ops import SphereGrid
from gsparc.tables.conventions import convert_conventions
from gsparc.tables.own_checks import HIGHEST_HZ, LOWEST_HZ, is_unit, quaternion_to_matrix

if TYPE_CHECKING:
    from gsparc.tables.sheet import Sheet

HEIGHT, WIDTH = 90, 360
WAVELENGTH = 0.3259  # [m], 920 MHz; fitted to the release's spectra: 0.3258 to 0.3260
SPLITS = ("train", "test")
STAND_IN = "rfid-sim"  # `dataset_name` of a simulated replacement


def planar_array(rows: int = 4, columns: int = 4, spacing_m: float = 0.16) -> np.ndarray:
    """Return element positions (rows * columns, 3)
    [m] of a grid centred in the receiver's xy plane.
    """
    x = (np.arange(columns) - (columns - 1) / 2) * spacing_m
    y = (np.arange(rows) - (rows - 1) / 2) * spacing_m
    grid_x, grid_y = np.meshgrid(x, y)
    return np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1).reshape(-1, 3)


def load_rfid(
    root: str | Path,
    *,
    gateway: str | None = None,
    wavelength_m: float = WAVELENGTH,
    array: np.ndarray | Mapping[str, Any] | None = None,
    normalisation: str = "max",
    listed: str | Path | int | None = None,
) -> Measurements:
    """Read a folder in the release's layout; spectra stay uint8 (S, 90, 360).

    Args:
        root: the folder.
        gateway: which receiver of gateway_info.yml; None takes the first.
        wavelength_m: carrier wavelength [m].
        array: (M, 3) [m] element positions, receiver frame, or arguments of `planar_array`; None
            for the release's 4 x 4 array.
        normalisation: how the published images were scaled.
        listed: CSV with the columns spectrum and split: only these are used, split like this; 160:
            those of our tables out of `gsparc data rfid-200`.

    Raises:
        DataError: anything is missing or wrong; all problems are listed with file and row.
    """
    root = Path(root)
    if not root.is_dir():
        raise DataError(
            f"{root}: no such folder; expected gateway_info.yml, tx_pos.csv and spectrum/ in it"
        )
    problems = Problems(root)
    info = _read_gateway(root / "gateway_info.yml", gateway, problems)
    moving: End = "rx" if (root / "rx_pos.csv").exists() else "tx"
    positions = _read_positions(root / f"{moving}_pos.csv", problems)
    count = None if positions is None else len(positions)
    spectra = _read_spectra(root / "spectrum", f"{moving}_pos.csv", count, problems)
    if moving == "rx" and (root / "freq.txt").exists():
        fault = "carriers of rows are read beside tx_pos.csv; with rx_pos.csv leave it out"
        problems.add(root / "freq.txt", fault)
    carriers = _read_carriers(root / "freq.txt", f"{moving}_pos.csv", count, problems)
    release_split = read_split(root, count, problems, first=1)
    rows = np.arange(count or 0)
    if listed is not None and count is not None:
        # 160 is shipped with the package: the rows of our tables,
        # whatever was downloaded around them.
        file = (
            files("gsparc.datasets.public").joinpath("rfid-160.csv")
            if listed in (160, "160")
            else listed
        )
        rows, release_split = _read_list(Path(str(file)), count, problems)
    problems.raise_if_any()
    assert info is not None and positions is not None and spectra is not None and count is not None
    # A simulated replacement has the layout, and says so in `dataset_name` so that tables mark it.
    simulated = info.dataset == STAND_IN
    layout = {} if array is None else array
    places = (
        planar_array(**layout) if isinstance(layout, Mapping) else np.asarray(layout, np.float64)
    )
    suffix = ".png" if spectra.dtype == np.uint8 else ".npy"
    name = STAND_IN if simulated else "rfid"
    site = Site(
        name,
        "spectrum",
        "rx",
        SphereGrid.hemisphere(HEIGHT, WIDTH),
        places,
        LIGHT / float(wavelength_m),
        None,
        normalisation=str(normalisation),
        stand_in="rfid" if simulated else None,
    )
    if moving == "rx":  # neither its array nor the carrier is in the files
        site = replace(site, name=info.dataset, static_end="tx", array=None, carrier_hz=None)
    turned = info.rotation if moving == "tx" else np.eye(3)
    still, rotation = (np.repeat(pose[None], len(rows), axis=0) for pose in (info.position, turned))
    tx, rx = (positions[rows], still) if moving == "tx" else (still, positions[rows])
    data = Measurements(
        site,
        tx,
        rx,
        rotation,
        spectra if listed is None else spectra[rows],
        row_names=[f"spectrum/{i + 1:05d}{suffix}" for i in rows],
        release_split=release_split,
        provenance={"release": info.dataset, "gateway": info.name, "layout": "rfid"},
    )
    if carriers is not None:
        half = planar_array(**{**layout, "spacing_m": 0.5} if isinstance(layout, Mapping) else {})
        data = _at_carriers(
            replace(data, site=replace(site, name=info.dataset)), carriers[rows], half
        )
    return centre_and_hash(data)


def _at_carriers(data: Measurements, carrier_hz: np.ndarray, array: np.ndarray) -> Measurements:
    """A station for each carrier (S,) [Hz], of an array (M, 3) in wavelengths;
    in our conventions.
    """
    carriers, station = np.unique(carrier_hz, return_inverse=True)
    arrays = LIGHT / carriers[:, None, None] * array[:, [2, 0, 1]]
    places = np.repeat(data.rx_position[:1], len(carriers), axis=0)
    names = [f"{carrier / 1e9:g} GHz" for carrier in carriers]
    turned = np.repeat(data.rx_rotation[:1], len(carriers), axis=0)
    stations = Stations(places, tuple(names), turned, carriers, array=arrays)
    site = replace(data.site, stations=stations, array=arrays[0], carrier_hz=float(carriers[0]))
    data = replace(data, site=site, station=station.reshape(-1), place=number_places(data.tx))
    return convert_conventions(data, ("zenith", "clockwise"))


def _read_list(path: Path, count: int, problems: Problems) -> tuple[np.ndarray, TrainTest | None]:
    """Rows (n,) that a list names, of `count`, and the (train, test) rows among them."""
    sheet = problems.attempt(lambda: _sheet(path, ["spectrum", "split"], problems))
    number = None if sheet is None else sheet.numbers("spectrum")
    if sheet is None or number is None:
        return np.zeros(0, np.int64), None
    part = sheet.words("split")
    wrong = np.flatnonzero(~(np.isin(number, np.arange(1, count + 1)) & np.isin(part, SPLITS)))
    expected = f"expected the number of a spectrum, 1 to {count}, and train or test"
    sheet.refuse_rows("spectrum", wrong, expected)
    return number.astype(np.int64) - 1, (
        np.flatnonzero(part == "train"),
        np.flatnonzero(part == "test"),
    )


def _sheet(path: Path, heads: list[str], problems: Problems) -> Sheet:
    """A table of these columns; `DataError` where it is none, or has others."""
    from gsparc.tables.opening import read_sheet  # here, as pandas takes half a second to import

    sheet = read_sheet(path, problems)
    sheet = replace(sheet, frame=sheet.frame.rename(columns=str.lower))
    if sorted(sheet.heads) != sorted(heads):
        header = ",".join(sheet.heads)
        raise DataError(f"{path}, line 1: expected the header {','.join(heads)}, found {header}")
    return sheet


class _Gateway(NamedTuple):
    """One receiver of gateway_info.yml: position (3,) [m], rotation (3, 3) local to world."""

    dataset: str
    name: str
    position: np.ndarray
    rotation: np.ndarray


def _read_gateway(path: Path, wanted: str | None, problems: Problems) -> _Gateway | None:
    entry = "entries like `gateway1: {position: [x, y, z], orientation: [x, y, z, w]}`"
    content = problems.attempt(
        lambda: read_yaml(path, "the gateway's position and orientation", entry)
    )
    if content is None:
        return None
    gateways = {str(k): v for k, v in content.items() if isinstance(v, Mapping)}
    name = next(iter(gateways), "gateway1") if wanted is None else wanted
    if name not in gateways:
        there = (
            f"there are {', '.join(gateways)}"
            if gateways
            else (f"no gateway in it; expected {entry}")
        )
        return problems.add(path, f"no gateway named {name!r}; {there}")
    pose = [gateways[name].get(key) for key in ("position", "orientation")]
    position, orientation = map(finite_array, pose)
    if position.shape != (3,):
        problems.add(path, f"{name}: position is {pose[0]}; expected three finite numbers [m]")
    else:
        check_positions(problems, str(path), position[None], [f"{name}: position"])
    # The release prints (x, y, z, w), the schema expects the scalar first.
    if orientation.shape != (4,) or not is_unit(orientation):
        expected = "expected a quaternion of four finite numbers (x, y, z, w), of length 1"
        return problems.add(path, f"{name}: orientation is {pose[1]}; {expected}")
    rotation = quaternion_to_matrix(orientation, scalar_first=False)
    return _Gateway(str(content.get("dataset_name", "unnamed")), name, position, rotation)


def _read_positions(path: Path, problems: Problems) -> np.ndarray | None:
    """Positions (S, 3) float64 [m] of the end that moves."""
    sheet = problems.attempt(lambda: _sheet(path, ["x", "y", "z"], problems))
    axes = [] if sheet is None else [sheet.numbers(axis) for axis in "xyz"]
    columns = [values for values in axes if values is not None]
    if sheet is None or len(columns) < len(axes):
        return None
    positions = np.stack(columns, axis=1)
    check_positions(problems, str(path), positions, [*sheet.rows])
    return positions


def _read_carriers(
    path: Path, positions: str, count: int | None, problems: Problems
) -> np.ndarray | None:
    """Carriers (S,) [Hz] of the rows; None where there is no such file."""
    if not path.exists() or count is None:
        return None
    words = (problems.attempt(lambda: read_text(path, "missing")) or "").split()
    carriers = 1e9 * parse_numbers(words)
    if carriers.shape != (count,) or not ((carriers >= LOWEST_HZ) & (carriers <= HIGHEST_HZ)).all():
        expected = (
            f"expected the carrier of each of the {count} rows of {positions} [GHz], one "
            "number a line"
        )
        return problems.add(path, f"{len(words)} words; {expected}")
    return carriers


def _read_spectra(
    folder: Path, positions: str, count: int | None, problems: Problems
) -> np.ndarray | None:
    """Images (S, 90, 360) uint8 or float32, in the order of their numbers;
    on disk where they are many.
    """
    if not folder.is_dir():
        return problems.add(folder, "missing; expected images 00001.png, 00002.png, ...")
    suffix = ".npy" if any(folder.glob("*.npy")) else ".png"
    there = {path.name for path in folder.glob(f"*{suffix}")}
    if count is None:
        return None
    expected = [f"{i:05d}{suffix}" for i in range(1, count + 1)]
    missing = [name for name in expected if name not in there]
    extra = sorted(there - set(expected))
    problems.add_rows(folder, missing, f"missing, but {positions} has {count} rows")
    problems.add_rows(folder, extra, f"no row for it in {positions}, which has {count} rows")
    if missing:
        return None
    # On disk where it is large: the release's 6,123 spectra are 200 MB.
    spectra = allocate((count, HEIGHT, WIDTH), np.uint8 if suffix == ".png" else np.float32)
    read = _read_image if suffix == ".png" else _read_numbers
    for i, name in enumerate(expected):
        problems.attempt(partial(read, folder / name, spectra[i]))
    return spectra


def _read_image(path: Path, into: np.ndarray) -> None:
    """Read one PNG into (90, 360) uint8, or raise `DataError`."""
    expected = f"expected an 8-bit grey PNG of {WIDTH} x {HEIGHT} pixels"
    errors = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
    # The format is fixed: Pillow would otherwise run any of its decoders on a damaged file.
    with (
        readable(path, f"{expected}, not readable", errors),
        Image.open(path, formats=["PNG"]) as image,
    ):
        if image.mode != "L" or image.size != (WIDTH, HEIGHT):
            size = (
                f"{image.size[0]} x {image.size[1]}" if image.mode == "L" else f"mode {image.mode}"
            )
            raise DataError(f"{path}: {expected}, found {size}")
        into[:] = np.asarray(image)


def _read_numbers(path: Path, into: np.ndarray) -> None:
    """Read one array into (90, 360) float32 from 0 to 1, or raise `DataError`."""
    expected = f"expected an array of {HEIGHT} x {WIDTH} numbers from 0 to 1, or of 8 bits"
    with readable(path, f"{expected}, not readable", (OSError, ValueError, EOFError)):
        image = np.load(path, allow_pickle=False).squeeze()
    if image.shape != (HEIGHT, WIDTH) or image.dtype.kind not in "fu":
        raise DataError(f"{path}: {expected}, found {image.dtype} {image.shape}")
    values = image / 255 if image.dtype == np.uint8 else image
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise DataError(f"{path}: {expected}, found {values.min():g} to {values.max():g}")
    into[:] = values


class RFID(Release):
    """The RFID release (NeRF2, set s23) or any folder in its layout; settings of `load_rfid`,
    `Release`.
    """

    called, reader = "RFID", staticmethod(load_rfid)
    hint = (
        "Get 200 of its spectra with `gsparc data rfid-200`, or all from "
        "the NeRF2 project (https://github.com/XPengZhao/NeRF2, data set s23: gateway_info.yml, "
        "tx_pos.csv, spectrum/)"
    )

    def read(self, folder: Path) -> Measurements:
        """Read spectra (S, 90, 360) uint8 of tags about a static gateway;
        stand-ins have no settings.
        """
        return super().read(folder) if folder == self.root else load_rfid(folder)
