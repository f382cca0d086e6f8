"""Places and carriers that nobody measured: rooms at ten carriers, ours beside plain methods.

python bench/bands.py FOLDER SEED              # rooms of a seed: half an hour of one core
python bench/bands.py FOLDER SEED box draws=3  # rooms whose names begin so; settings of
                                               # `gsparc compare`, which does the rest

Three rooms of Sionna (`make sionna`): the meshes of `../shared/data/wideband`, the conference room,
cabinets in a box; three shoeboxes of known mirrors; the last of either is turned. Fifty places .9 m
apart, half of them in sight of the gateway; array and spectrum of XFreq-GS. Held out: a fifth of
the places, and each carrier in its turn.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from beside_plain import compare_with_plain
from PIL import Image

from gsparc.data.schema import LIGHT
from gsparc.datasets.rfid import planar_array
from gsparc.simulate.effects import Effects
from gsparc.simulate.llvm import prepare_llvm
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.conference import conference_room
from gsparc.simulate.scenes.solid import Solid, box
from gsparc.simulate.scenes.transmitters import Antenna
from gsparc.simulate.shoebox import Room, mirror_images, visible_images

SCENE = Path(__file__).resolve().parents[2] / "shared" / "data" / "wideband" / "scene" / "scene.xml"
GHZ = (1, 2.4, 5, 10, 24.25, 37, 47, 60, 77, 94)
ELEMENTS = planar_array(spacing_m=0.5)[:, [2, 0, 1]]  # [wavelengths]
EFFECTS = Effects(diffuse=False, edge_diffraction=False, polarisation=False)
COUNT, APART_M, TURN = 50, 0.9, 0.4  # of places; of the world [rad]
CORNERS = {"home": [[-6, -3, 0], [6, 3, 3]], "hall": [[0, 0, 0], [14, 10, 4]]}  # [m]
# Of places (n, 3), a gateway (3,), a carrier [Hz] and most bounces: gains (n, P) without the
# carrier's phase, metres (n, P), directions at the gateway (n, P, 3).
Paths = tuple[np.ndarray, np.ndarray, np.ndarray]
Trace = Callable[[np.ndarray, np.ndarray, float, int], Paths]


def rooms(seed: int) -> Iterator[tuple[str, np.ndarray, Trace]]:
    """Yield names, corners (2, 3) [m] and what traces paths there."""
    for number, name in enumerate(("home", "hall", "cabinets", "box_0", "box_1", "box_2")):
        rng = np.random.default_rng([seed, number])
        size = rng.uniform([8, 6, 2.6], [12, 9, 3.6])
        low = np.c_[rng.uniform(0.1, 0.8, (6, 2)) * size[:2], np.zeros(6)]
        cabinets = np.stack([low, low + rng.uniform([0.4, 0.4, 1.2], [1.6, 1.6, 2.4], (6, 3))], 1)
        solids = [
            box(f"cabinet{i}", ("wood", "metal")[i % 2], *cabinet)
            for i, cabinet in enumerate(cabinets)
        ]
        traces: dict[str, Trace] = {
            "home": partial(traced, SCENE),
            "hall": partial(traced, conference_room(int(1e6 * size[0]))),
            "cabinets": partial(traced, [box("shell", "concrete", 0 * size, size), *solids]),
        }
        walls = partial(mirrored, size, cabinets, rng.uniform(0.3, 0.8, 6), rng.uniform(0, 0.1, 6))
        yield name, np.array(CORNERS.get(name, [[0, 0, 0], size])), traces.get(name, walls)


def mirrored(
    size: np.ndarray, cabinets: np.ndarray, strength: np.ndarray, falls: np.ndarray, *asked: Any
) -> Paths:
    """Trace a shoebox whose walls reflect less from octave to octave; `asked` as of `Trace`."""
    places, gateway, carrier, depth = asked
    room = Room(0 * size, size, -strength * (carrier / 1e9) ** -falls, cabinets)
    images = mirror_images(room, min(depth, 2))
    free = room.contains(places) & room.contains(gateway)
    seen = visible_images(room, images, places, gateway) & free[:, None]
    way = images.mirror_points(places) - gateway
    metres = np.linalg.norm(way, axis=2)
    return seen * images.gain / metres, metres, way / metres[..., None]


def traced(
    source: Path | list[Solid], places: np.ndarray, gateway: np.ndarray, carrier: float, depth: int
) -> Paths:
    """Trace a room of Sionna from the gateway: ways are the same back."""
    prepare_llvm()
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    for laws in ITU_MATERIALS_PROPERTIES.values():
        laws[0.0, 1e3] = [*laws.values()][-1]  # brick's ends at 40 GHz
    engine = RayTracer(
        source, gateway, carrier, Sampling(30_000, len(places)), antenna=Antenna("dipole")
    )
    found = next(engine.trace_in_batches(places, replace(EFFECTS, depth=depth)))[0]
    away, turn, delay = (np.array(one)[:, 0] for one in (found.theta_t, found.phi_t, found.tau))
    direction = np.stack(
        [np.sin(away) * np.cos(turn), np.sin(away) * np.sin(turn), np.cos(away)], 2
    )
    free = engine.clear_of_surfaces(places, 0.2) & engine.clear_of_surfaces(gateway[None], 0.2)
    gains = (np.array(found.a[0]) + 1j * np.array(found.a[1])).reshape(away.shape)
    return (
        gains * np.array(found.valid).reshape(away.shape) * free[:, None],
        LIGHT * delay,
        direction,
    )


def make_room(
    folder: Path, rng: np.random.Generator, corners: np.ndarray, trace: Trace, turn: float
) -> None:
    """Write a room in the layout that `dataset=rfid` reads."""
    low, high = corners
    along = map(np.arange, low[:2] + rng.uniform(0.2, 0.7, 2), high[:2] - 0.2, [APART_M] * 2)
    every = np.stack(np.meshgrid(*along), -1).reshape(-1, 2)
    every = rng.permutation(np.c_[every, low[2] + rng.uniform(0.8, 1.7, len(every))])
    found = []
    for gateway in rng.uniform(0.8 * low + 0.2 * high, 0.2 * low + 0.8 * high, (4, 3)):
        seen, heard = ((trace(every, gateway, 5e9, depth)[0] != 0).any(1) for depth in (0, 1))
        found.append((seen, heard & ~seen, gateway))
    seen, hidden, gateway = max(found, key=lambda one: min(one[0].sum(), one[1].sum()))
    half = max(COUNT // 2, COUNT - int(hidden.sum()))
    places = every[np.r_[np.flatnonzero(seen)[:half], np.flatnonzero(hidden)[: COUNT - half]]]
    cosine, sine = np.cos(turn), np.sin(turn)
    world = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])  # of rows
    # Runs clockwise
    zenith, azimuth = np.radians(np.meshgrid(np.arange(90), np.arange(360), indexing="ij"))
    looks = np.stack(
        [np.sin(zenith) * np.cos(azimuth), -np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
    )
    steering = np.exp(-2j * np.pi * np.einsum("kij,mk->mij", looks, ELEMENTS))
    images, arrives = [], np.full(len(places), True)
    for carrier in np.array(GHZ) * 1e9:
        gains, metres, direction = trace(places, gateway, carrier, 3)
        waves, turned = (
            gains * np.exp(-2j * np.pi * np.mod(carrier / LIGHT * metres, 1.0)),
            direction @ world,
        )
        vectors = np.einsum("np,npm->nm", waves, np.exp(2j * np.pi * turned @ ELEMENTS.T))
        images.append(np.abs(np.einsum("nm,mij->nij", vectors, steering)))
        arrives &= gains.any(1)
    image = np.concatenate([rows[arrives] for rows in images])
    (folder / "spectrum").mkdir(parents=True)
    for number, one in enumerate(
        np.round(255 * image / image.max((1, 2), keepdims=True)).astype(np.uint8), 1
    ):
        Image.fromarray(one).save(folder / "spectrum" / f"{number:05d}.png")
    pose = f"gateway1: {{position: {(gateway @ world).tolist()}, orientation: [0, 0, 0, 1]}}\n"
    (folder / "gateway_info.yml").write_text("dataset_name: bands\n" + pose)
    np.savetxt(folder / "freq.txt", np.repeat(GHZ, arrives.sum()), "%g")
    rows = np.tile(places[arrives] @ world, (len(GHZ), 1))
    np.savetxt(folder / "tx_pos.csv", rows, "%.6f", ",", header="x,y,z", comments="")


def main() -> None:
    """Make rooms, and compare on them."""
    folder, seed, *words = sys.argv[1:]
    datasets, wanted = {}, tuple(word for word in words if "=" not in word) or ""
    for number, (name, corners, trace) in enumerate(rooms(int(seed))):
        root = Path(folder) / f"{name}_{seed}"
        if not name.startswith(wanted):
            continue
        if not root.exists():
            rng = np.random.default_rng([int(seed), number, 1])
            make_room(root, rng, corners, trace, TURN * (number % 3 == 2))
        datasets[root.name] = {"dataset": "rfid", "root": str(root)}
    splits = {"places": {"choose": ["split=random", "split.redraw=true"]}}
    splits |= {"carriers": {"choose": ["split=carriers"], "draws": 0}}
    compare_with_plain(Path(folder), datasets, splits, words)


if __name__ == "__main__":
    main()
