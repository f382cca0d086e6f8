"""Paths at places as a DeepMIMO scenario, version 4: `params.json` and a file for each quantity."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gsparc.data.schema import LIGHT
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.predictor import Predictor

PATHS = 25  # that a DeepMIMO scenario has at most
DIRECT_M = 0.1  # a source so near the static end is that end


def write_scenario(folder: Path, predictor: Predictor, place: np.ndarray) -> tuple[int, float]:
    """Write a scenario: the static end is DeepMIMO's transmitter, places (n, 3) [m,
    world] are receivers.

    A source that is not the static end is given as one reflection, in the plane that mirrors the
    one into the other: directions and delays are the source's,
    points of several reflections are not.

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
    power = np.square(np.abs(paths.gain[:, 0].astype(np.complex128)))
    order = np.argsort(-power, axis=1)[:, :PATHS]

    def top(value: np.ndarray) -> np.ndarray:
        return np.take_along_axis(value, order.reshape(order.shape + (1,) * (value.ndim - 2)), 1)

    strongest, towards, delay = top(power), top(paths.direction), top(paths.delay_s[:, 0])
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
    silent = strongest <= 0
    arrays = {
        "power": to_decibels(np.where(silent, np.nan, strongest)),
        "delay": delay,
        "phase": np.degrees(np.angle(top(paths.gain[:, 0]))),
        "inter": np.where(direct, 0.0, 1.0),
        "inter_pos": meets[:, :, None],
    }
    for name, direction in (("aoa", towards), ("aod", leaves)):
        arrays[f"{name}_az"] = np.degrees(np.arctan2(direction[..., 1], direction[..., 0]))
        arrays[f"{name}_el"] = np.degrees(
            np.arccos(direction[..., 2].clip(-1, 1))
        )  # from the zenith
    for value in arrays.values():
        value[silent] = np.nan
    for name, value in (arrays | {"rx_pos": place, "tx_pos": still[None]}).items():
        # In UTM float32 moves in steps of .5 m
        kind = np.float64 if name.endswith("pos") else np.float32
        np.savez_compressed(folder / f"{name}_t000_tx000_r001.npz", **{name: value.astype(kind)})
    np.savez_compressed(folder / "vertices.npz", vertices=np.zeros((0, 3), np.float32))
    (folder / "objects.json").write_text("[]")
    (folder / "params.json").write_text(
        json.dumps(_parameters(paths.reference_hz, place, silent), indent=1)
    )
    return int((~silent).sum(1).max()), float(1 - strongest.sum() / max(power.sum(), 1e-300))


def _parameters(carrier_hz: float, place: np.ndarray, silent: np.ndarray) -> dict[str, object]:
    def end(number: int, points: int, heard: int) -> dict[str, object]:
        return {
            "name": "rx" if number else "tx",
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
    heard = int((~silent).any(1).sum())
    sets = {"txrx_set_0": end(0, 1, 1), "txrx_set_1": end(1, len(place), heard)}
    scene = {
        "num_scenes": 1,
        "n_objects": 0,
        "n_vertices": 0,
        "n_faces": 0,
        "n_triangular_faces": 0,
    }
    return {
        "version": "4.0.0",
        "rt_params": tracer,
        "scene": scene,
        "materials": {},
        "txrx_sets": sets,
    }
