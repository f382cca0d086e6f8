"""Small invented files in the layouts of measured campaigns."""

from pathlib import Path

import h5py
import numpy as np
from scipy.io import netcdf_file

HOSTS = np.array(["A05", "A06", "B05"])
ANTENNAS = np.array([[7.85, 0.66, 2.4], [7.85, 1.26, 2.4], [6.65, 0.66, 2.4]])
RUNS = np.array(["EXP005", "EXP006"])
CYCLES = 8  # of each run; the first has no position in EXP006, the last was measured in EXP005 only
KINDS = ("netcdf3", "netcdf4")


def channels_of(places: np.ndarray) -> np.ndarray:
    """Line of sight (..., 3) at 920 MHz from `places` (..., 3) [m] to the three antennas."""
    distance = np.linalg.norm(places[..., None, :] - ANTENNAS, axis=-1)
    return np.exp(-2j * np.pi * 920e6 / 299_792_458 * distance) / distance


def techtile_arrays() -> dict[str, np.ndarray]:
    """Twelve places in two runs before three antennas, as in the npz; one entry is not measured."""
    rng = np.random.default_rng(0)
    places = rng.uniform([1, 1, 0.7], [3, 3, 0.8], (12, 3))
    mask = np.ones((12, 3), bool)
    mask[4, 1] = False
    return {
        "tx_position": places,
        "rx_antenna_position": ANTENNAS,
        "csi": np.where(mask, channels_of(places), 0).astype(np.complex64),
        "mask": mask,
        "run": np.repeat(RUNS, [8, 4]),
        "frequency_hz": np.array(920e6),
    }


def release_variables() -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Dimensions and values of the variables of a small NetCDF file in Techtile's layout."""
    rng = np.random.default_rng(1)
    where = rng.uniform([1, 1, 0.7], [3, 3, 0.8], (2, CYCLES, 3))
    stored = channels_of(where).conj()  # reference minus received phase
    placed, heard = np.ones((2, CYCLES), np.int8), np.ones((2, CYCLES, 3), np.int8)
    placed[1, 0], where[1, 0] = 0, np.nan
    heard[1, -1], stored[1, -1] = 0, np.nan
    heard[0, 3, 2], stored[0, 3, 2] = 0, np.nan
    over = ("experiment_id", "cycle_id")
    return {
        "experiment_id": (over[:1], RUNS),
        "cycle_id": (over[1:], np.arange(1, CYCLES + 1, dtype=np.int32)),
        "hostname": (("hostname",), HOSTS),
        **{f"rover_{axis}": (over, where[..., i]) for i, axis in enumerate("xyz")},
        "position_available": (over, placed),
        "csi_real": ((*over, "hostname"), stored.real.copy()),
        "csi_imag": ((*over, "hostname"), stored.imag.copy()),
        "csi_available": ((*over, "hostname"), heard),
    }


def write_release(
    folder: Path, kind: str = "netcdf3", variables=None, antennas: bool = True
) -> Path:
    """A NetCDF file of the release, and Techtile's table of antennas beside it."""
    variables = release_variables() if variables is None else variables
    path = folder / "csi.nc"
    (_write_netcdf3 if kind == "netcdf3" else _write_netcdf4)(path, variables)
    if antennas:
        rows = [
            f"- tile: {host}\n  channels:\n  - {{x: 0, y: 0, z: 0}}\n"
            f"  - {{x: {place[0]}, y: {place[1]}, z: {place[2]}}}\n"
            for host, place in zip(HOSTS[::-1], ANTENNAS[::-1], strict=True)
        ]
        (folder / "techtile_antenna_locations.yml").write_text("antennes:\n" + "".join(rows))
    return path


def _write_netcdf3(path: Path, variables) -> None:
    with netcdf_file(str(path), "w", version=2) as file:
        for name, (dimensions, values) in variables.items():
            if values.dtype.kind == "U":  # text is an array of characters
                values = values.astype("S")
                width = values.dtype.itemsize
                values = np.frombuffer(values.tobytes(), "S1").reshape(*values.shape, width)
                dimensions = (*dimensions, f"string{width}_{name}")
            for dimension, size in zip(dimensions, values.shape, strict=True):
                if dimension not in file.dimensions:
                    file.createDimension(dimension, size)
            file.createVariable(name, values.dtype, dimensions)[:] = values


def _write_netcdf4(path: Path, variables) -> None:
    with h5py.File(path, "w") as file:
        for name, (_, values) in variables.items():
            text = values.dtype.kind == "U"
            kind = h5py.string_dtype() if text else values.dtype
            file.create_dataset(name, data=values.astype(object) if text else values, dtype=kind)


STATIONS = np.array(["ebc-nuc1-b210", "madsen-nuc2-b210", "cbrssdr1-fm-comp"])
CAMPUS = np.array([40.7649, -111.8406])
DEGREES = np.array([[40.7677, -111.83816], [40.75786, -111.83634], [40.75807, -111.85325]])


def metres_of(degrees: np.ndarray) -> np.ndarray:
    """East and north (..., 2) [m] of latitudes and longitudes (..., 2) about the campus,
    as in the npz.
    """
    north, east = np.moveaxis(degrees - CAMPUS, -1, 0)
    return np.stack([84_313.2 * east, 110_574.0 * north], axis=-1)


def powder_arrays(walk: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """A walk (of twenty places) heard by three stations, as in the npz;
    two links were not heard.
    """
    if walk is None:
        walk = CAMPUS + np.cumsum(np.random.default_rng(0).normal(0, 3e-4, (20, 2)), axis=0)
    distance = np.linalg.norm(metres_of(walk)[:, None] - metres_of(DEGREES), axis=-1)
    rssi = (-20 - 25 * np.log10(distance)).astype(np.float32)
    rssi[[3, 7], [0, 2]] = np.nan
    return {
        "mobile_position": metres_of(walk),
        "station_position": metres_of(DEGREES),
        "station": STATIONS,
        "rssi_db": rssi,
        "latitude": walk[:, 0],
        "longitude": walk[:, 1],
        "frequency_hz": np.array(462.7e6),
    }


TABLE = (
    '{\n   "bus-6186": None,\n'
    + "".join(f'    "{s}": ({a}, {b}),\n' for s, (a, b) in zip(STATIONS, DEGREES, strict=True))
    + "}"
)  # Python's notation under a name that ends in .json, as in the release


def write_walk(folder: Path, change=lambda text: text, table: str = TABLE) -> Path:
    """The same walk as the release's CSV, with a bus, and the table of stations beside it."""
    arrays = powder_arrays()
    lines = [
        "timestamp,bus-6186_rss,bus-6186_x,bus-6186_y,"
        + ",".join(STATIONS)
        + ",tx_x_coord,tx_y_coord"
    ]
    for i, row in enumerate(np.nan_to_num(arrays["rssi_db"].astype(float), nan=-101)):
        powers = ",".join("-101" if p == -101 else f"{p!r}" for p in row.tolist())
        time, place = (
            f"2022-11-23 13:24:{i:02d}",
            f"{arrays['latitude'][i]!s},{arrays['longitude'][i]!s}",
        )
        lines.append(f"{time},-101,-1,-1,{powers},{place}")
    (folder / "single_tx.csv").write_text(change("\n".join(lines) + "\n"))
    (folder / "location_coordinates.json").write_text(table)
    return folder / "single_tx.csv"


def ble_arrays() -> dict[str, np.ndarray]:
    """A beacon at fifteen places of a hall with four sensors."""
    rng = np.random.default_rng(0)
    places = rng.uniform([0, 0, 1.8], [20, 17, 1.9], (15, 3))
    sensors = np.array([[7, 7, 1.2], [7, 0.7, 2.3], [13, 12, 1.2], [18, 12, 2.3]])
    distance = np.linalg.norm(places[:, None] - sensors, axis=-1)
    return {
        "mobile_position": places,
        "station_position": sensors,
        "station": np.array(["sensor10", "sensor11", "sensor40", "sensor42"]),
        "rssi_db": (-50 - 20 * np.log10(distance)).astype(np.float32),
        "frequency_hz": np.array(2.44e9),
    }


MAKERS = {"techtile": techtile_arrays, "powder": powder_arrays, "ble": ble_arrays}


def write_npz(folder: Path, name: str, change=lambda arrays: arrays) -> Path:
    """The npz of a campaign: `techtile`, `powder` or `ble`."""
    np.savez(folder / f"{name}.npz", **change(MAKERS[name]()))
    return folder / f"{name}.npz"
