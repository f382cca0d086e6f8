"""`model=calibrated_raytracer`: the geometry is known, the materials are learned.

A ray tracer that is told where everything stands, and learns from the measurements what it is made
of (`gsparc.simulate.calibration`), with one gain of both ends. Nothing is interpolated: where it
traces no path, it predicts the median of the training rows where it traces none.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch

from gsparc.base.limits import Checked, setting, whole
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.target import Kind
from gsparc.models.method import Method, Prediction
from gsparc.models.target_rows import heard_rows
from gsparc.physics.decibels import finite_decibels, from_decibels, to_decibels
from gsparc.simulate.calibration import (
    GENERIC,
    Material,
    Replay,
    RoomCalibration,
    apply_materials,
    calibrate_materials,
    used_materials,
)
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.build import known_scene, load_tracer
from gsparc.simulate.scenes.settings import from_config
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

# Diffuse scattering has parameters of its own, which nothing here learns; interactions of a path
EFFECTS = Effects(
    diffraction=True, edge_diffraction=False, diffuse=False, polarisation=False, depth=5
)
SAMPLING = Sampling(100_000, 400)


@dataclass(eq=False, kw_only=True)
class CalibratedRayTracer(Checked, Method):
    """Powers, or channels of one antenna, from traced paths.

    Args:
        scene: see `known_scene`; None: the one that a simulated file names.
        steps: most evaluations of likelihood and gradient; 0 learns the gain alone.
    """

    name = "calibrated_raytracer"
    no_gradient = "rays are traced to a place anew"
    kinds: ClassVar[tuple[Kind, ...]] = ("rssi", "csi")
    is_yardstick: ClassVar[bool] = True  # type: ignore[misc]
    scene: str | None = None
    steps: int = setting(40, whole(0))
    learned: RoomCalibration | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._scene_json, self._silent_db, self._factor = "", 0.0, 1.0 + 0.0j
        self._tracer: RayTracer | None = None

    def why_not(self, data: Measurements) -> str | None:
        """Return why it cannot serve these measurements; None where it may."""
        site = data.site
        if site.kind not in self.kinds:
            return f"{self.name}: needs received powers or channels, not {site.kind}"
        if site.target.is_complex and data.target.shape[1] != 1:
            return f"{self.name}: needs channels of one antenna"
        if site.static_position is None or not np.isfinite(site.static_position).all():
            return f"{self.name}: needs one end that stands still at a known place"
        if site.carrier_hz is None:
            return f"{self.name}: the carrier is unknown; materials need it"
        return None

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Trace the training rows, and learn materials and gain from their powers.

        Raises:
            ValueError: other data than `problem` allows, no known scene, or paths to fewer than 2
                rows.
            SimulatorMissing: Sionna is not installed.
        """
        fault = self.why_not(data)
        if fault is not None:
            raise ValueError(fault)
        begin = Stopwatch()
        self.site = data.site
        try:
            scene = known_scene(self.scene, data.provenance, float(data.site.carrier_hz or 0.0))
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error
        self._scene_json, self._tracer = json.dumps(asdict(scene)), None
        rows = heard_rows(data, fold.learned())
        # Measurements are local, the tracer's scene is in world coordinates.
        places, measured = data.moving[rows] + data.site.origin, _measured_decibels(data, rows)
        tracer = self._loaded_tracer()
        start = dict.fromkeys(used_materials(tracer), GENERIC)
        # Before the replay, whose first powers are those under the start's materials.
        apply_materials(tracer, start)
        # Paths are traced once: materials change what they carry, not where they run.
        replay = Replay(tracer, places, EFFECTS)
        traced = replay.received_powers()
        reached = traced > 0
        # Gain and scale of the residuals are learned at least: two unknowns.
        if reached.sum() < 2:
            raise ValueError(
                f"{self.name}: paths reach {reached.sum()} training rows; is this the scene?"
            )
        self.learned = calibrate_materials(replay, start, traced, measured, self.steps)
        # Without paths in training, what is weakest there is the best guess of what lies deeper.
        self._silent_db = float(
            np.median(measured[~reached]) if not reached.all() else measured.min()
        )
        # Powers tell a gain in decibels; channels need its phase too.
        if data.site.target.is_complex:
            self._factor = self._best_factor(data, rows)
        return FitReport(begin.seconds, self._describe_fit(len(rows) - int(reached.sum())))

    def _describe_fit(self, dark: int) -> tuple[str, ...]:
        assert self.learned is not None
        materials = ", ".join(
            f"{name} {material.permittivity:.3g} and {material.conductivity:.2g} S/m"
            for name, material in self.learned.materials.items()
        )
        notes = [
            f"permittivity and conductivity of {materials}; residuals "
            f"{self.learned.scale_db:.2g} dB"
        ]
        if dark:
            notes.append(
                f"{dark} training rows have no path; such places get {self._silent_db:.4g} dB"
            )
        return tuple(f"{self.name}: {note}" for note in notes)

    def _best_factor(self, data: Measurements, rows: np.ndarray) -> complex:
        """The complex factor of least squared error over `rows`."""
        traced = self._channels(self._trace(data.moving[rows])).ravel()
        energy = np.vdot(traced, traced).real
        return complex(np.vdot(traced, data.target[rows].ravel()) / energy) if energy > 0 else 0j

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; `ValueError` before `fit` or `restore`."""
        site, learned = self.fitted_site, self.require_fitted(self.learned)
        paths = self._trace(query.places(site).detach().numpy())
        if site.target.is_complex:
            return Prediction(
                torch.from_numpy((self._channels(paths) * self._factor).astype(np.complex64))
            )
        power = paths.received_power()
        # No path is -inf dB, which the silent level replaces.
        with np.errstate(divide="ignore"):
            level = np.where(power > 0, to_decibels(power) + learned.gain_db, self._silent_db)
        return Prediction(torch.from_numpy(from_decibels(level))[:, None].float())

    def _channels(self, paths: TracedPaths) -> np.ndarray:
        """(B, 1, K) without the factor."""
        assert self.site is not None and self.site.wavelength is not None
        return paths.responses(self.site.tones(), np.zeros((1, 3)), self.site.wavelength)[:, :1]

    def _trace(self, places: np.ndarray) -> TracedPaths:
        """Paths to places (B, 3) [m], local."""
        return self._loaded_tracer().trace(places + self.fitted_site.origin, EFFECTS)

    def _loaded_tracer(self) -> RayTracer:
        """The scene under what was learned, loaded when it is first asked."""
        if self._tracer is None:
            assert self.site is not None and self.site.static_position is not None
            scene = from_config(json.loads(self._scene_json))
            place = self.site.static_position + self.site.origin
            self._tracer = load_tracer(scene, SAMPLING, place, self.site.name)
            if self.learned is not None:
                apply_materials(self._tracer, self.learned.materials)
        return self._tracer

    def state(self) -> dict[str, Any]:
        """Return the scene's settings, the materials, the gain."""
        assert self.learned is not None
        return {
            "scene": self._scene_json,
            "learned": asdict(self.learned),
            "silent_db": self._silent_db,
            "factor": [self._factor.real, self._factor.imag],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`; the scene is loaded with the first prediction."""
        self.site, self._scene_json, self._tracer = site, str(state["scene"]), None
        stored = state["learned"]
        materials = {name: Material(**one) for name, one in stored["materials"].items()}
        self.learned = RoomCalibration(**{**stored, "materials": materials})
        self._silent_db, self._factor = float(state["silent_db"]), complex(*state["factor"])


def _measured_decibels(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Powers (n,) of `rows` in decibels of stored units; of channels the mean over tones."""
    power = data.site.target.power(data.target[rows]).reshape(len(rows), -1)
    measured = (
        np.ones(power.shape, bool) if data.mask is None else data.mask[rows].reshape(power.shape)
    )
    # A row without any measured tone has power 0, not 0 / 0.
    power = (power * measured).sum(axis=1) / np.maximum(measured.sum(axis=1), 1)
    return finite_decibels(power)
