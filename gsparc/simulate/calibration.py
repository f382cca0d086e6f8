"""Materials of a known scene, from received powers: paths are traced once,
fields computed in every step.

J. Hoydis et al., "Learning Radio Environments by Differentiable Ray Tracing", IEEE Trans. Mach.
Learn. Commun. Netw. 2 (2024), arXiv:2311.18558: relative permittivity and conductivity by gradient,
through Sionna's Fresnel and diffraction coefficients. Where rays go does not depend on materials,
so that one step is a replay of the stored paths under other materials and not a trace.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from gsparc.physics.decibels import to_decibels
from gsparc.simulate.effects import Effects
from gsparc.simulate.raytracer import RayTracer

log = logging.getLogger(__name__)

# Degrees of freedom of Student's t, the density of residuals: shadows are missed by tens of dB
TAILS = 4.0
TINY_W = 1e-30  # power that has a logarithm, far below any path's
# Deviation of the logarithms of permittivity - 1 and of conductivity about the start
PRIOR = (1.0, 2.0)
RANGE = 4.0  # of a logarithm about its start, in these deviations
LEAST_DB = 0.5  # scale of the residuals: below, the posterior is a needle that no search finds
ROUNDS = 100  # of expectation maximisation


@dataclass(frozen=True)
class Material:
    """Of a surface.

    >>> again = Material.from_logarithms(Material(5.0, 0.05).logarithms())
    >>> round(again.permittivity, 6), round(again.conductivity, 6)
    (5.0, 0.05)

    Attributes:
        permittivity: relative, above 1.
        conductivity: [S/m].
    """

    permittivity: float
    conductivity: float

    def logarithms(self) -> np.ndarray:
        """Return what is optimised (2,)."""
        # A conductor's permittivity is 1, an insulator's conductivity 0: neither has a logarithm.
        return np.log([max(self.permittivity - 1, 1e-3), max(self.conductivity, 1e-6)])

    @staticmethod
    def from_logarithms(logarithms: np.ndarray) -> Material:
        """Return the material of these logarithms (2,)."""
        return Material(1 + math.exp(logarithms[0]), math.exp(logarithms[1]))


GENERIC = Material(5.0, 0.05)  # between brick and concrete at a few GHz (ITU-R P.2040)


@dataclass(frozen=True)
class RoomCalibration:
    """What was learned.

    Attributes:
        materials: by name.
        gain_db: measured over traced power [dB].
        scale_db: of the residuals' density [dB].
        steps: evaluations of the likelihood and its gradient.
    """

    materials: dict[str, Material]
    gain_db: float
    scale_db: float
    steps: int


def used_materials(tracer: RayTracer) -> dict[str, Material]:
    """Return materials of the scene's surfaces, as the tracer has them."""
    return {
        name: Material(
            float(radio_material.relative_permittivity[0]), float(radio_material.conductivity[0])
        )
        for name, radio_material in sorted(tracer.radio_materials().items())
    }


def apply_materials(tracer: RayTracer, materials: Mapping[str, Material]) -> None:
    """Give the scene's surfaces these materials."""
    import drjit as dr
    import mitsuba as mi

    there = tracer.radio_materials()
    for name, material in materials.items():
        if name in there:
            # Plain numbers are constants of kernels:
            # every other value would compile all of them anew.
            there[name].relative_permittivity = dr.opaque(mi.Float, material.permittivity)
            there[name].conductivity = dr.opaque(mi.Float, material.conductivity)


class Replay:
    """Paths of receivers (R, 3) [m], world, with what is needed to send fields along them again.

    The tracer's present materials decide which paths are tried.
    """

    def __init__(self, tracer: RayTracer, receivers: np.ndarray, effects: Effects) -> None:
        self.tracer, self._count = tracer, len(receivers)
        self._parts: list[tuple[dict[str, Any], Any]] = []
        first = 0
        for solution, count in tracer.trace_in_batches(receivers, effects):
            self._parts.append(_field_arguments(tracer, solution, effects, first))
            first += count

    def received_powers(self) -> np.ndarray:
        """Sum path powers (R,) under the scene's present materials; 0 where no path arrives."""
        return self._powers().numpy().astype(np.float64)

    def cost_and_gradient(
        self,
        materials: Mapping[str, np.ndarray],
        slopes: Callable[[np.ndarray], tuple[float, np.ndarray]],
    ) -> tuple[float, np.ndarray]:
        """Evaluate a function of the powers in decibels, and its gradient by the materials.

        Args:
            materials: logarithms (2,) by name.
            slopes: (R,) [dB] -> the function's value and its slopes (R,).

        Returns:
            The value, and its slopes (2 per material, in their order).
        """
        import drjit as dr
        import mitsuba as mi

        there, free = self.tracer.radio_materials(), []
        for name, logarithms in materials.items():
            # As in `apply_materials`
            pair = [dr.opaque(mi.Float, float(value)) for value in logarithms]
            for logarithm in pair:
                dr.enable_grad(logarithm)
            there[name].relative_permittivity = 1 + dr.exp(pair[0])
            there[name].conductivity = dr.exp(pair[1])
            free += pair
        power = self._powers()
        level = 10 / math.log(10) * dr.log(power + TINY_W)
        value, by_level = slopes(dr.detach(level).numpy().astype(np.float64))
        dr.backward(dr.sum(level * mi.Float(by_level.astype(np.float32))))
        gradient = np.array([dr.grad(logarithm).numpy()[0] for logarithm in free], dtype=np.float64)
        apply_materials(
            self.tracer, {name: Material.from_logarithms(pair) for name, pair in materials.items()}
        )  # without gradients
        invalid = ~np.isfinite(gradient)
        if invalid.any():
            log.warning(
                "%d of %d slopes by materials are not finite: these do not move in this step",
                int(invalid.sum()),
                len(gradient),
            )
        return value, np.where(invalid, 0.0, gradient)

    def _powers(self) -> Any:
        """(R,) as the solver's array, with gradients: evaluated loops have them,
        and cost the same here.
        """
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.path_solvers.field_calculator import FieldCalculator

        calculator, total = FieldCalculator(), dr.zeros(mi.Float, self._count)
        calculator.loop_mode = "evaluated"
        for arguments, owner in self._parts:
            # The buffer is shared by all calls: each changes its flags in place, which made the
            # kernel of every step longer than that of the one before.
            valid = mi.Bool(arguments["paths"].valid)
            gains = calculator(**arguments).a
            arguments["paths"].valid = valid
            for row in gains:
                for gain in row:
                    dr.scatter_add(
                        total, dr.square(dr.real(gain)) + dr.square(dr.imag(gain)), owner
                    )
        return total


def _field_arguments(
    tracer: RayTracer, solution: Any, effects: Effects, first: int
) -> tuple[dict[str, Any], Any]:
    """Arguments of the field calculator, and the receivers of the paths, from `first` on."""
    import mitsuba as mi

    scene, buffer = tracer.scene, solution._paths_buffer
    sources, turned, *_ = scene.sources(True, True)
    targets, facing, *_ = scene.targets(True, True)
    arguments = {
        "wavelength": scene.wavelength,
        "paths": buffer,
        "samples_per_src": tracer.sampling.samples,
        "diffraction": effects.diffraction,
        "src_positions": sources,
        "tgt_positions": targets,
        "src_orientations": turned,
        "tgt_orientations": facing,
        "src_antenna_patterns": scene.tx_array.antenna_pattern.patterns,
        "tgt_antenna_patterns": scene.rx_array.antenna_pattern.patterns,
    }
    return arguments, mi.UInt(buffer.target_indices) + first


def calibrate_materials(
    replay: Replay,
    start: Mapping[str, Material],
    traced: np.ndarray,
    measured_db: np.ndarray,
    steps: int,
) -> RoomCalibration:
    """Find materials, one gain and the residuals' scale of largest posterior.

    Residuals have Student's density of `TAILS` degrees of freedom, whose gain and scale follow from
    the materials (`fit_gain_and_scale`). Logarithms of the materials have a normal prior about the
    start, so that those that no path meets stay there. The replay's scene keeps the materials.

    Args:
        replay: paths to R receivers.
        start: materials to begin with, and the prior's mean.
        traced: (R,) powers under them; receivers without any are not learned from.
        measured_db: (R,) [dB].
        steps: most evaluations; 0 learns gain and scale alone.
    """
    reached = traced > 0
    gain, scale = fit_gain_and_scale(measured_db[reached] - to_decibels(traced[reached]))
    if not steps:
        return RoomCalibration(dict(start), gain, scale, 0)
    centre = np.concatenate([material.logarithms() for material in start.values()])
    deviation = np.tile(PRIOR, len(start))
    best = (np.inf, centre, gain, scale)
    spent = 0

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal spent, best
        spent += 1
        gain, scale = 0.0, 0.0

        def slopes(level: np.ndarray) -> tuple[float, np.ndarray]:
            # Of largest likelihood gain and scale have no slope: that of the rest is the whole one.
            nonlocal gain, scale
            missed, by_level = measured_db[reached] - level[reached], np.zeros(len(level))
            gain, scale = fit_gain_and_scale(missed)
            value, by_level[reached] = student_loss(gain - missed, scale)
            return value, by_level

        value, by_material = replay.cost_and_gradient(
            dict(zip(start, x.reshape(-1, 2), strict=True)), slopes
        )
        away = (x - centre) / deviation
        # Of a row: the search begins with a step as long as the gradient.
        value = (value + 0.5 * float(away @ away)) / len(traced)
        # Out of looks, the search need not end at the best point that it saw.
        if value < best[0]:
            best = (value, x.copy(), gain, scale)
        return value, (by_material + away / deviation) / len(traced)

    bounds = [(c - RANGE * d, c + RANGE * d) for c, d in zip(centre, deviation, strict=True)]
    options = {"maxfun": steps, "maxiter": steps}
    minimize(objective, centre, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    _, x, gain, scale = best
    materials = {
        name: Material.from_logarithms(x) for name, x in zip(start, x.reshape(-1, 2), strict=True)
    }
    apply_materials(replay.tracer, materials)
    return RoomCalibration(materials, gain, scale, spent)


def fit_gain_and_scale(missed: np.ndarray) -> tuple[float, float]:
    """Return location and scale of largest likelihood of Student's density, `missed` (n,) [dB].

    Expectation maximisation (K. L. Lange et al., J. Am. Stat. Assoc. 84 (1989)); a scale of at
    least `LEAST_DB`.

    >>> missed = np.array([2.0, 3.0, 3.0, 3.0, 4.0, 60.0])  # [dB], the last by a shadow
    >>> bool(fit_gain_and_scale(missed)[0] < missed.mean() / 3)
    True
    """
    gain = float(np.median(missed))
    scale = max(float(np.median(np.abs(missed - gain))), LEAST_DB)
    for _ in range(ROUNDS):
        # The expectation: receivers far off their level weigh little.
        weight = (TAILS + 1) / (TAILS + ((missed - gain) / scale) ** 2)
        gain = float(weight @ missed / weight.sum())
        scale = max(math.sqrt(float(weight @ (missed - gain) ** 2) / len(missed)), LEAST_DB)
    return gain, scale


def student_loss(residual: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood of residuals (n,) but for a constant, and its slopes (n,).

    >>> value, slopes = student_loss(np.zeros(2), scale=1.0)
    >>> value, slopes.tolist()
    (0.0, [0.0, 0.0])
    """
    z = residual / scale
    value = float((TAILS + 1) / 2 * np.log1p(z**2 / TAILS).sum() + len(z) * math.log(scale))
    return value, (TAILS + 1) * z / (TAILS + z**2) / scale
