"""Small measurement problems, from fixed seeds and NumPy alone, whatever gsparc is inside."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

C = 299_792_458.0
SIZE = np.array([4.0, 3.0, 2.5])  # of the room [m]
STILL = np.array([0.6, 0.8, 1.9])  # the end that does not move [m]
POSTS = np.array([[0.0, 0.0, 6.0], [40.0, 5.0, 6.0], [15.0, 30.0, 6.0]])
QUERIES = 12
# Carriers [Hz]: a metre of wavelength, of which few rows tell much, and 125 mm
LONG, SHORT = 3.0e8, 2.4e9

Arrays = dict[str, Any]


@dataclass(frozen=True)
class Problem:
    """What is learned and asked.

    Attributes:
        arrays: makes what was measured; the last `QUERIES` rows are asked.
        model: that learns them.
        command: more words of `gsparc train`.
        slow: whether its fit takes more than some seconds.
    """

    arrays: Callable[[], Arrays]
    model: str = "gsparc"
    command: tuple[str, ...] = ()
    slow: bool = False


def places(rows: int, seed: int, margin: float = 0.3) -> np.ndarray:
    """Positions (rows, 3) all over the room [m]."""
    return np.random.default_rng(seed).uniform(margin, SIZE - margin, (rows, 3))


def mirrors(end: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Amplitudes and positions (3,) of an end and its six images in the walls."""
    result = [(1.0, end)]
    for axis in range(3):
        for side in (0.0, SIZE[axis]):
            image = end.copy()
            image[axis] = 2 * side - image[axis]
            result.append((-0.5, image))
    return result


def channel(
    at: np.ndarray, still: np.ndarray, tones: np.ndarray, antennas: np.ndarray
) -> np.ndarray:
    """Channels (rows, antennas, tones) at places (rows, 3),
    whose antennas are `at` + offsets (A, 3).
    """
    total = np.zeros((len(at), len(antennas), len(tones)), complex)
    for amplitude, image in mirrors(still):
        far = np.linalg.norm(at[:, None] + antennas - image, axis=-1)[..., None]
        total += amplitude * np.exp(-2j * np.pi * tones * far / C) / far
    return total


def noisy(clean: np.ndarray, db: float, seed: int) -> np.ndarray:
    """With circular noise, so many dB below."""
    rng = np.random.default_rng(seed)
    scale = np.sqrt((abs(clean) ** 2).mean() / 2) * 10 ** (-db / 20)
    return clean + scale * (rng.normal(size=(*clean.shape, 2)) @ [1, 1j])


def channels(
    rows: int,
    carrier: float = LONG,
    tones: int = 1,
    antennas: int = 1,
    moving: str = "rx",
    **more: Any,
) -> Arrays:
    """Of a room with one end that moves."""
    comb = carrier + 2e6 * np.arange(tones)
    array = np.column_stack([0.5 * C / carrier * np.arange(antennas), np.zeros((antennas, 2))])
    at = places(rows, 1)
    if moving == "rx":
        csi, ends = channel(at, STILL, comb, array), {"rx": at, "tx": STILL}
    else:  # the array stands still, and each of its elements sees the place that moves
        seen = [channel(at, STILL + one, comb, np.zeros((1, 3))) for one in array]
        csi, ends = np.concatenate(seen, axis=1), {"rx": STILL, "tx": at}
    csi = noisy(csi, 30, 2)
    shaped = csi if antennas > 1 else csi[:, 0] if tones > 1 else csi[:, 0, 0]
    arrays = {**ends, "csi": shaped, "frequency_hz": comb if tones > 1 else carrier, **more}
    return arrays | ({"array_position": array} if antennas > 1 else {})


def runs() -> Arrays:
    """Channels of three runs, each in a phase and level of its own."""
    arrays = channels(72)
    run = np.arange(72) % 3
    return arrays | {"csi": arrays["csi"] * np.array([1, 1.2j, -0.8])[run], "run": run}


def both_ends() -> Arrays:
    """Channels whose two ends move."""
    at, other = places(80, 1), places(80, 5)
    pairs = zip(at, other, strict=True)
    csi = np.array(
        [channel(a[None], b, np.array([LONG]), np.zeros((1, 3)))[0, 0, 0] for a, b in pairs]
    )
    return {"rx": at, "tx": other, "csi": noisy(csi, 30, 2), "frequency_hz": LONG}


def planar(side: int, spacing: float) -> np.ndarray:
    """Antennas (side^2, 3) [m] across x and y."""
    line = spacing * (np.arange(side) - (side - 1) / 2)
    return np.column_stack(
        [*(axis.ravel() for axis in np.meshgrid(line, line)), np.zeros(side * side)]
    )


def spectra(rows: int, declared: bool, moving: str = "tx", side: int = 4) -> Arrays:
    """Bartlett spectra (rows, 12, 24) of 8 bits that an upright planar array measures in the
    room.
    """
    array = planar(side, 0.5 * C / SHORT)
    elevation, azimuth = np.meshgrid(
        np.deg2rad(np.arange(12) * 90 / 12), np.deg2rad(np.arange(24) * 360 / 24), indexing="ij"
    )
    towards = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    wavelength = C / SHORT
    steering = np.exp(2j * np.pi / wavelength * towards.reshape(-1, 3) @ array.T)
    floor = np.array([2.0, 1.5, 0.2])
    at = places(rows, 3) * [0.3, 0.3, 0.2] + [1.0, 1.0, 1.6]
    ends = (
        (np.tile(floor, (rows, 1)), at)
        if moving == "tx"
        else (at * [1, 1, 0.1], np.tile(STILL, (rows, 1)))
    )
    pictures = []
    for receiver, transmitter in zip(*ends, strict=True):
        vector = np.zeros(len(array), complex)
        for amplitude, image in mirrors(transmitter):
            far = np.linalg.norm(receiver + array - image, axis=1)
            vector += amplitude * np.exp(-2j * np.pi * far / wavelength) / far
        picture = abs(steering.conj() @ vector).reshape(12, 24)
        pictures.append(np.round(255 * picture / picture.max()))
    fixed = {"tx": ends[1], "rx": floor} if moving == "tx" else {"tx": STILL, "rx": ends[0]}
    images = np.array(pictures, np.uint8)
    known = {"array_position": array, "carrier_hz": SHORT} if declared else {}
    return {**fixed, "spectrum": images, **known}


def shadowing(
    rows: int, stations: int, seed: int = 0, noise_db: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Places (rows, 3) and levels (rows, stations) [dBm]: a distance law and 5 dB over 8 m."""
    rng = np.random.default_rng(0)
    at = np.column_stack([rng.uniform(0, [40, 30], (rows, 2)), np.full(rows, 1.5)])
    apart = np.linalg.norm(at[:, None] - at, axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / 8) + 1e-6 * np.eye(rows))
    far = np.linalg.norm(at[:, None] - POSTS[:stations], axis=-1)
    level = -30 - 28 * np.log10(far) + 5 * root @ rng.normal(size=far.shape)
    return at, level + noise_db * rng.normal(size=far.shape)


def powers(rows: int, **more: Any) -> Arrays:
    """Of one station."""
    at, level = shadowing(rows, 1)
    return {"rx": at, "tx": POSTS[0], "rssi": level[:, 0], **more}


def silent() -> Arrays:
    """Powers of one station that is not heard below -75 dBm."""
    arrays = powers(110)
    return arrays | {
        "rssi": np.where(arrays["rssi"] < -75, np.nan, arrays["rssi"]),
        "sensitivity_db": -75.0,
    }


def stations() -> Arrays:
    """Powers of three stations, with some that were not measured."""
    at, level = shadowing(90, 3)
    level[::7, 1] = np.nan
    return {"tx": at, "station_position": POSTS, "rssi": level}


def moving_powers() -> Arrays:
    """Powers between two ends that move."""
    rng = np.random.default_rng(4)
    ends = [
        np.column_stack([rng.uniform(0, [40, 30], (90, 2)), np.full(90, 1.5)]) for _ in range(2)
    ]
    level = -30 - 25 * np.log10(np.linalg.norm(ends[0] - ends[1], axis=1) + 1)
    return {"rx": ends[0], "tx": ends[1], "rssi": level + rng.normal(size=90)}


def imprecise() -> Arrays:
    """Powers where positions have errors of .5 m."""
    arrays = powers(90)
    error = np.random.default_rng(6).normal(0, 0.5, (90, 3)) * [1, 1, 0]
    return arrays | {"rx": arrays["rx"] + error, "position_std": 0.5}


def directed() -> Arrays:
    """Channels with where each of seven paths came from."""
    arrays = channels(60)
    towards = np.array([image for _, image in mirrors(STILL)]) - arrays["rx"][:, None]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    offsets = 7 * np.arange(61)
    return arrays | {"path_direction": towards.reshape(-1, 3), "path_offsets": offsets}


def snapshots() -> Arrays:
    """Uplink and downlink of 8 antennas in 26 tones each, and where the users were."""
    comb = SHORT + 312.5e3 * np.array([*range(-26, 0), *range(1, 27)])
    array = STILL + np.column_stack([0.5 * C / SHORT * np.arange(8), np.zeros((8, 2))])
    at = places(110, 1)
    seen = [channel(at, antenna, comb, np.zeros((1, 3))) for antenna in array]
    both = noisy(np.concatenate(seen, axis=1), 30, 2).astype(np.complex64)
    return {
        "rx": at,
        "uplink": both[..., :26],
        "csi": both[:, :1, 26:],
        "both": both,
        "array": array,
    }


# Words of `gsparc train` that a tree may not know yet, and what said the same before.
BEFORE = {"model=image_source_gp": "model=vsgp", "model=directional_gp": "model=directed"}
# Searches that end by themselves within a second.
FEW = ("init.searches=3", "init.search_rows=200", "init.max_sources=8")

PROBLEMS: dict[str, Problem] = {
    "spectra": Problem(lambda: spectra(60, declared=False)),
    "spectra of an array": Problem(lambda: spectra(60, declared=True), slow=True),
    "spectra of a moving array": Problem(
        lambda: spectra(44, declared=True, moving="rx"), "moving_array", slow=True
    ),
    "one tone": Problem(lambda: channels(80), command=FEW, slow=True),
    "many tones": Problem(lambda: channels(60, tones=6), command=FEW, slow=True),
    "antennas": Problem(lambda: channels(60, tones=2, antennas=3), command=FEW, slow=True),
    "uplink of an array": Problem(
        lambda: channels(60, antennas=4, moving="tx"), command=FEW, slow=True
    ),
    "uplink of snapshots": Problem(
        snapshots, "uplink", ("dataset=argos", "dataset.positions=true")
    ),
    "waves alone": Problem(lambda: channels(80, SHORT), "complex_gp"),
    "sources alone": Problem(
        lambda: channels(80),
        "image_source_gp",
        ("model.searches=2", "model.search_rows=64", "model.max_sources=8"),
    ),
    "aligned runs": Problem(runs, command=FEW),
    "both ends move, channels": Problem(both_ends),
    "known walls": Problem(
        lambda: channels(60), command=("init=scene", "init.file={folder}/room.yaml"), slow=True
    ),
    "directions": Problem(directed, "directional_gp"),
    "powers": Problem(lambda: powers(110)),
    "silent rows": Problem(silent),
    "stations, each": Problem(stations, command=("stations=each",)),
    "stations together": Problem(stations, command=("stations=together",)),
    "both ends move, powers": Problem(moving_powers),
    "positions with errors": Problem(imprecise),
    "kriging": Problem(lambda: powers(110), "kriging"),
}


def parted(arrays: Arrays) -> tuple[Arrays, Arrays]:
    """What is learned from, and the last `QUERIES` rows: where, and what was measured there."""
    rows = max(len(arrays[end]) for end in ("rx", "tx") if np.ndim(arrays.get(end)) == 2)
    learned, asked = {}, {}
    for name, value in arrays.items():
        rowwise = np.ndim(value) > 0 and len(value) == rows
        learned[name] = value[:-QUERIES] if rowwise else value
        asked[name] = value[-QUERIES:] if rowwise else value
    if "path_offsets" in arrays:
        learned["path_offsets"] = arrays["path_offsets"][:-QUERIES]
        learned["path_direction"] = arrays["path_direction"][: learned["path_offsets"][-1]]
    return learned, asked


def written(arrays: Arrays, folder: Path) -> tuple[str, ...]:
    """Write measurements, and `room.yaml` of the walls;
    the words of `gsparc train` that name the file.
    """
    (folder / "room.yaml").write_text(f"room: {{size_m: {SIZE.tolist()}}}\n", encoding="utf-8")
    if "uplink" in arrays:
        np.save(folder / "csidata.npy", arrays["both"])
        np.save(folder / "positions.npy", arrays["rx"])
        described = f"base_station: {arrays['array'].tolist()}\n"
        (folder / "base-station.yml").write_text(described, encoding="utf-8")
        return (f"dataset.root='{folder}'",)
    names = {"rx": "rx_position", "tx": "tx_position", "rssi": "rssi_db"}
    np.savez(folder / "own.npz", **{names.get(name, name): value for name, value in arrays.items()})
    return ("dataset=own", f"dataset.file='{folder / 'own.npz'}'")
