"""Paths at places as a DeepMIMO scenario, version 4: `params.json` and a file for each quantity."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gsparc.data.schema import LIGHT, Site
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.predictor import Predictor

PATHS = 25  # that a DeepMIMO scenario has at most
DIRECT_M = 0.1  # a source so near the static end is that end


def write_scenario(folder: Path, predictor: Predictor, place: np.ndarray) -> tuple[int, float]:
    """Write a scenario: the static end is DeepMIMO's transmitter, places (n, 3) [m,
    world] are receivers.

    Antennas of what stands are transmitters of one set, of what moves a set of receivers each. A
    source that is not the static end is given as one reflection, in the plane that mirrors the one
    into the other, and seen from the array's middle: directions and delays are the source's, points
    of several reflections are not. Channels of DeepMIMO have their tones from the carrier up, those
    of a model about it.

    Returns: the most paths of a place, and the share of power that those beyond `PATHS` have.

    Raises:
        ValueError: another model.
    """
    site = predictor.site
    if site.static_position is None:
        raise ValueError("to=deepmimo: where the static end stands must be known")
    paths = predictor.paths(**site.name_moving(place))
    if paths.direction is None:
        raise ValueError("to=deepmimo: paths with directions are needed")
    still = np.asarray(site.static_position, np.float64) + site.origin
    gain = paths.gain.astype(np.complex128)
    power = np.square(np.abs(gain))
    order = np.argsort(-power.mean(1), axis=1)[:, :PATHS]

    def top(value: np.ndarray) -> np.ndarray:
        return np.take_along_axis(value, order.reshape(order.shape + (1,) * (value.ndim - 2)), 1)

    towards, delay = top(paths.direction), top(paths.delay_s.mean(1))
    away = LIGHT * delay[..., None] * towards  # from a place to the source
    normal = place[:, None] + away - still
    distance = np.linalg.norm(normal, axis=-1, keepdims=True)
    direct = distance[..., 0] < DIRECT_M
    normal /= np.maximum(distance, DIRECT_M)
    # The path leaves the static end as its mirror image leaves the source;
    # where it meets the mirror:
    turned = 2 * (towards * normal).sum(-1, keepdims=True) * normal
    leaves = np.where(direct[..., None], 0, turned) - towards
    share = 1 - distance / 2 / np.maximum((away * normal).sum(-1, keepdims=True), 1e-9)
    meets = np.where(direct[..., None] | (share <= 0), np.nan, place[:, None] + share * away)
    arrays = {"inter": np.where(direct, 0.0, 1.0), "inter_pos": meets[:, :, None]}
    for name, direction in (("aoa", towards), ("aod", leaves)):
        arrays[f"{name}_az"] = np.degrees(np.arctan2(direction[..., 1], direction[..., 0]))
        arrays[f"{name}_el"] = np.degrees(
            np.arccos(direction[..., 2].clip(-1, 1))
        )  # from the zenith
    moves = site.array is not None and site.static_end == "tx"
    strongest, offsets = np.stack([top(part) for part in power.swapaxes(0, 1)]), _offsets(site)
    for antenna, told in enumerate(strongest):
        offset, silent = offsets[antenna % len(offsets)], told <= 0
        of_antenna = {
            "power": to_decibels(np.where(silent, np.nan, told)),
            "delay": top(paths.delay_s[:, antenna]),
            "phase": np.degrees(np.angle(top(gain[:, antenna]))),
            **{name: value.copy() for name, value in arrays.items()},
        }
        for value in of_antenna.values():
            value[silent] = np.nan
        ends = {"rx_pos": place + offset * moves, "tx_pos": (still + offset * (not moves))[None]}
        label = f"t000_tx000_r{1 + antenna:03d}" if moves else f"t000_tx{antenna:03d}_r001"
        for name, value in (of_antenna | ends).items():
            # In UTM float32 moves in steps of .5 m
            kind = np.float64 if name.endswith("pos") else np.float32
            np.savez_compressed(folder / f"{name}_{label}.npz", **{name: value.astype(kind)})
    # A scene without objects cannot be printed: the ground below all places, which no path touches.
    low, high = np.r_[place, still[None]].min(0) - 1, np.r_[place, still[None]].max(0) + 1
    corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    ground = np.c_[corners, np.full(4, low[2])]
    np.savez_compressed(folder / "vertices.npz", vertices=ground)
    faces = {"face_vertex_idxs": [[0, 1, 2, 3]], "face_material_idxs": [0]}
    plane = {"name": "ground", "label": "terrain", "id": 0, **faces}
    (folder / "objects.json").write_text(json.dumps([plane]))
    heard = (strongest > 0).any(2).sum(1).tolist()
    (folder / "params.json").write_text(
        json.dumps(_parameters(paths.reference_hz, place, heard, moves), indent=1)
    )
    return int((strongest > 0).sum(2).max()), float(1 - strongest.sum() / max(power.sum(), 1e-300))


def _offsets(site: Site) -> np.ndarray:
    """Antennas (A, 3) [m, world] from the place of their end; one at it where that is unknown."""
    if site.array is None:
        return np.zeros((1, 3))
    rotation = np.eye(3) if site.rx_rotation is None else np.asarray(site.rx_rotation, np.float64)
    return np.asarray(site.array, np.float64) @ rotation.T


def _parameters(
    carrier_hz: float, place: np.ndarray, heard: list[int], moves: bool
) -> dict[str, object]:
    """Of the scenario, by the places that each antenna hears, of the end that moves or stands."""

    def end(number: int, points: int, heard: int) -> dict[str, object]:
        return {
            "name": f"rx{number - 1 or ''}" if number else "tx",
            "id": number,
            "id_orig": number,
            "is_tx": not number,
            "is_rx": bool(number),
            "num_points": points,
            "num_active_points": heard,
            "num_ant": 1,
            "dual_pol": False,
            "ant_rel_positions": [[0, 0, 0]],
            "array_orientation": [0, 0, 0],
        }

    tracer = {
        "raytracer_name": "gsparc",
        "raytracer_version": "0.1.0",
        "frequency": carrier_hz,
        "max_path_depth": 1,
        "max_reflections": 1,
        "max_diffractions": 0,
        "max_scattering": 0,
        "max_transmissions": 0,
    }
    senders, receivers = (1, heard) if moves else (len(heard), [max(heard)])
    counts = [(senders, senders), *((len(place), count) for count in receivers)]
    sets = {f"txrx_set_{number}": end(number, *both) for number, both in enumerate(counts)}
    # Printing a data set asks for names of materials.
    material = {
        "id": 0,
        "name": "ground",
        "permittivity": 1.0,
        "conductivity": 0.0,
        "scattering_model": "none",
        "scattering_coefficient": 0.0,
        "cross_polarization_coefficient": 0.0,
    }
    scene = {
        "num_scenes": 1,
        "n_objects": 1,
        "n_vertices": 4,
        "n_faces": 1,
        "n_triangular_faces": 2,
    }
    return {
        "version": "4.0.0",
        "rt_params": tracer,
        "scene": scene,
        "materials": {"material_0": material},
        "txrx_sets": sets,
    }
