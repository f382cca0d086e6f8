"""`model=complex_gp`: a Gaussian process on complex channels from the carrier alone, without sources.

Waves from all around make neighbouring channels correlated as sin(kd) / (kd) (R. K. Cook et al., "Measurement
of correlation coefficients in reverberant sound fields", J. Acoust. Soc. Am. 27 (1955)); a Matern-3/2
envelope over distance bounds the correlation. Real and imaginary parts share one kernel: the circular complex
process. Rows of a run (`Measurements.run`) share an unknown complex factor, estimated by likelihood;
predictions at places are those of the largest run, those of measured rows their own run's where it is known.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.blocks import taken
from gsparc.data.links.stations import numbered
from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext, FitReport, LeftOut, Method, Prediction
from gsparc.methods.run_factors import RunFactors, run_factors
from gsparc.multipath.waves.kernels import plain
from gsparc.ops import Pose
from gsparc.processes.covering import covering
from gsparc.processes.factor import Factor
from gsparc.processes.left_out import left_out
from gsparc.processes.nearest import solved
from gsparc.processes.neighbourhood import Neighbourhood

LENGTHS = (0.25, 1.0, 4.0, 16.0)  # wavelengths, candidates of the envelope's length
NOISES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # of the signal's power, candidates
CHOSEN_ON = 1_000  # rows that length and noise are chosen on: each look factors a matrix
MOST_ROWS = 6_000  # whose covariance is factored as one: of more, each place is told by the nearest
NEAREST = 100  # rows that tell of a query: waves from all around are not screened as shadows are
TRIED_ON = 300  # of these, rows whose density given their neighbours chooses the settings
ENTRIES = 64  # of their channels
QUERIES = 32  # at a time, each with the channels of its neighbours: memory
NAMED = 6  # factors of runs that a note gives


@dataclass(frozen=True)
class _Solved:
    """Negative log likelihood, factor of m rows, weights (m, R), factors that align rows (m,)."""

    nll: float
    factor: Factor
    weights: Tensor
    aligning: Tensor


class ComplexGP(Method):
    """`sinc(2 d / wavelength) * Matern-3/2(d / length)`; length and noise by likelihood on a grid.

    Where both ends move the covariance is the product of both ends'.
    """

    name = "complex_gp"
    both_ends = True

    def __init__(self) -> None:
        self.site: Site | None = None
        self.near: Neighbourhood | None = None  # of rows too many for one factor

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return self.name if self.near is None else f"{self.name} (Vecchia {NEAREST})"

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Fit to `train` and `val`; `ValueError` unless the data are channels of a known carrier."""
        started = time.monotonic()
        if data.site.kind != "csi" or data.site.wavelength is None:
            raise ValueError("complex_gp: needs complex channels (csi) of a known carrier; take model=gp")
        known = np.concatenate([fold.train, fold.val])
        self.site = data.site
        self.shape = tuple(data.target.shape[1:])
        self.places, self.near = torch.from_numpy(data.moving[known]), None
        one_run = data.run is None or len(np.unique(data.run[known])) == 1  # factors of several need all rows
        if len(known) > MOST_ROWS and one_run:
            said = tuple(f"complex_gp: {note}" for note in self._fit_many(data, known))
            return FitReport(time.monotonic() - started, said)
        target = torch.from_numpy(np.asarray(data.target[known])).reshape(len(known), -1).to(torch.complex128)
        looked_at = torch.arange(len(known))
        if len(known) > CHOSEN_ON:
            drawn = np.random.default_rng(0).permutation(len(known))[:CHOSEN_ON]
            looked_at = torch.from_numpy(np.sort(drawn))
        names, run = np.unique(
            np.zeros(len(known)) if data.run is None else data.run[known], return_inverse=True
        )
        lengths = [length * data.site.wavelength for length in LENGTHS]
        tried = [
            (self._solve(target, length, noise, looked_at, run).nll, length, noise)
            for length in lengths
            for noise in NOISES
        ]
        _, self.length, self.noise = min(tried, key=lambda t: t[0])
        solved = self._solve(target, self.length, self.noise, torch.arange(len(known)), run)
        self.factor, self.weights, self.turned = solved.factor, solved.weights, 1 / solved.aligning
        self.power = max(float((target * solved.aligning[:, None]).abs().square().mean()), 1e-30)
        notes = [f"complex_gp: envelope {self.length:.3g} m, noise {self.noise:.0e} of the signal's power"]
        if len(known) > CHOSEN_ON:
            notes.append(f"complex_gp: settings chosen on {CHOSEN_ON} of {len(known)} rows, drawn evenly")
        first = torch.from_numpy(np.unique(run, return_index=True)[1])
        self.runs = RunFactors(names.astype(np.int64), self.turned[first])
        if len(names) > 1:
            notes.append(self._factors_note(names, run))
        return FitReport(time.monotonic() - started, tuple(notes))

    def _fit_many(self, data: Measurements, known: np.ndarray) -> tuple[str, ...]:
        """Rows (n,) of one run, too many for one factor: their channels, and settings given neighbours."""
        assert self.site is not None and self.site.wavelength is not None
        scatter = self._places_once(data, known)
        near = self.near = Neighbourhood.of(self.places.numpy(), 0)
        row = covering(near.places, TRIED_ON, 0)
        others, _ = near.nearest(near.places[row], row, NEAREST)
        rows = np.c_[row, others]
        at = torch.from_numpy(near.places[rows])
        entries = np.random.default_rng(0).permutation(self.targets.shape[1])[:ENTRIES]
        values = torch.from_numpy(self.targets[rows[..., None], entries])
        share = 1 / torch.from_numpy(self.count[rows])  # of the noise, in a mean
        again, around = float((1 / share[:, 0] - 1).sum()), float(scatter[row].sum())
        tried = []
        for length in (length * self.site.wavelength for length in LENGTHS):
            covariance = self._correlation(at, at, length)
            for noise in NOISES:
                gram = covariance[:, 1:, 1:] + torch.diag_embed(noise * share[:, 1:])
                weights, told = solved(gram, covariance[:, 0, 1:])
                missed = values[:, 0] - torch.einsum("tk,tkr->tr", weights.to(values.dtype), values[:, 1:])
                variance = 1 + noise * share[:, 0] - told
                power = float((missed.abs().square().mean(1) / variance).sum()) + around / noise
                power, unsure = (
                    power / (len(row) + again),
                    float(variance.log().sum()) + again * np.log(noise),
                )
                tried.append((np.log(max(power, 1e-300)) + unsure / (len(row) + again), length, noise))
        _, self.length, self.noise = min(tried, key=lambda t: t[0])
        self.power = max(float(values[:, 0].abs().square().mean()), 1e-30)
        self.runs = RunFactors.none()
        said = f"envelope {self.length:.3g} m, noise {self.noise:.0e} of the signal's power"
        of = f"of {len(self.places)} places, of" if len(self.places) < len(known) else "of"
        told_by = f"each query is predicted from the {NEAREST} nearest {of} {len(known)} rows (Vecchia)"
        return said, told_by, f"settings chosen on {len(row)} of them, each given its nearest"

    def _places_once(self, data: Measurements, known: np.ndarray) -> np.ndarray:
        """Take each place of rows (n,) once, with the mean of its channels; what was spread about it (m,).

        A hundred nearest rows of one place, where a robot waited, tell of no other.
        """
        place = numbered(self.places.numpy())
        _, self.first, count = np.unique(place, return_index=True, return_counts=True)
        self.count, self.targets = count.astype(np.float64), taken(data.target, known).reshape(len(known), -1)
        if len(count) == len(known):
            return np.zeros(len(known))
        order = np.argsort(place, kind="stable")
        starts = np.cumsum(count) - count
        sums, squares = (
            np.add.reduceat(part[order], starts)
            for part in (self.targets, (np.abs(self.targets) ** 2).mean(1))
        )
        self.places, self.targets = self.places[self.first], sums / count[:, None].astype(np.float32)
        return np.maximum(squares - count * (np.abs(self.targets) ** 2).mean(1), 0)

    def _factors_note(self, names: np.ndarray, run: np.ndarray) -> str:
        """A note of the factors of runs (n,), numbers into `names` (runs,)."""
        first = [int(np.flatnonzero(run == number)[0]) for number in range(len(names))][:NAMED]
        factors = self.turned.numpy()[first]
        listed = ", ".join(
            f"{name:g}: {abs(factor):.3g} at {np.degrees(np.angle(factor)):.0f} degrees"
            for name, factor in zip(names, factors, strict=False)
        )
        more = f", and {len(names) - NAMED} more" if len(names) > NAMED else ""
        largest = names[np.bincount(run).argmax()]
        return f"complex_gp: factors of runs, relative to run {largest:g}: {listed}{more}"

    def _solve(self, target: Tensor, length: float, noise: float, rows: Tensor, run: np.ndarray) -> _Solved:
        """Weights of `rows` (m,) for an envelope's length [m]; the best power and runs' factors are taken."""
        places, target, number = self.places[rows], target[rows], run[rows.numpy()]
        gram = self._correlation(places, places, length)
        gram.diagonal().add_(noise)
        factor = Factor.of(gram)
        aligning = torch.ones(len(rows), dtype=torch.complex128)
        if len(np.unique(number)) > 1:
            inverse = factor.inverse.numpy()
            _, number = np.unique(number, return_inverse=True)
            aligning = torch.from_numpy(run_factors(inverse, target.numpy(), number)[number])
            target = target * aligning[:, None]
        weights = factor.solved(target)
        fit = float((target.conj() * weights).real.sum()) / (2 * target.numel())
        determinant = 0.5 * float(factor.log_determinant) / len(target)
        nll = 0.5 * np.log(max(fit, 1e-300)) + determinant - float(aligning.abs().log().mean())
        return _Solved(nll, factor, weights, aligning)

    def _correlation(self, a: Tensor, b: Tensor, length: float) -> Tensor:
        """Between places (..., n, 3) and (..., m, 3) [m], or (..., 6) of both ends."""
        assert self.site is not None and self.site.wavelength is not None
        return plain(a, b, 2 * math.pi / self.site.wavelength, length)

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        if self.site is None:
            raise ValueError("complex_gp: not fitted yet; call fit or restore first")
        if self.near is not None:
            with torch.no_grad():
                mean, left = self._nearest_posterior(self.near, self._moving(tx, rx))
            variance = left / (1 + self.noise)
            sure = (1 - variance).float().clamp(0, 1)
            return Prediction(mean, sure, (self.power * variance).float())
        with torch.no_grad():
            cross = self._cross(tx, rx)
        known = self.factor.whitened(cross.T).square().sum(0)
        variance = (1 + self.noise - known).clamp_min(0) / (1 + self.noise)
        return Prediction(
            self._mean(cross),
            confidence=(1 - variance).float().clamp(0, 1),
            variance=(self.power * variance).float(),
        )

    def answer(self, batch: Batch) -> Prediction:
        """Each row in the phase and level of its run; of a run that was not learned from, of the largest."""
        return self.runs.restored(self.predict(batch.tx, batch.rx), batch.run)

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """The mean alone (B, A, K) complex64; see `Differentiable`."""
        if self.near is not None:
            return self._nearest_posterior(self.near, self._moving(tx, rx))[0]
        return self._mean(self._cross(tx, rx))

    def _nearest_posterior(
        self, near: Neighbourhood, queries: Tensor, without: np.ndarray | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean (B, A, K) complex64 and variance of a measurement (B,), of the power, by the nearest rows."""
        means, left = [], []
        for start in range(0, len(queries), QUERIES):
            part = queries[start : start + QUERIES]
            own = None if without is None else without[start : start + QUERIES]
            row, _ = near.nearest(part.detach().numpy(), own, NEAREST)
            places = torch.from_numpy(near.places[row])
            gram = self._correlation(places, places, self.length)
            gram.diagonal(dim1=-2, dim2=-1).add_(self.noise / torch.from_numpy(self.count[row]))
            weights, told = solved(gram, self._correlation(part[:, None], places, self.length)[:, 0])
            values = torch.from_numpy(self.targets[row])
            means.append(torch.einsum("bk,bkr->br", weights.to(values.dtype), values))
            left.append((1 + self.noise - told).clamp_min(0))
        return torch.cat(means).reshape(-1, *self.shape), torch.cat(left)

    def leave_one_out(self) -> LeftOut:
        """See `LeaveOneOut`; rows are those of the fit, counted from 0; of visits to a place, the first."""
        if self.near is not None:
            every = np.arange(len(self.places))
            mean = self._nearest_posterior(self.near, self.places, every)[0].flatten(1)
            return LeftOut(self.first, (torch.from_numpy(self.targets) - mean).to(torch.complex128))
        residual, _ = left_out(self.factor.precision, self.weights)
        return LeftOut(np.arange(len(self.places)), self.turned[:, None] * residual)

    def _moving(self, tx: Tensor, rx: Pose) -> Tensor:
        """Places (B, 3) float64 [m] of the moving end, (B, 6) of both."""
        assert self.site is not None
        return self.site.moving(tx, rx).expand(len(tx), -1).cpu().double()

    def _cross(self, tx: Tensor, rx: Pose) -> Tensor:
        """Covariance (B, n) of the moving end's places with those learned from."""
        return self._correlation(self._moving(tx, rx), self.places, self.length)

    def _mean(self, cross: Tensor) -> Tensor:
        mean = torch.complex(cross @ self.weights.real, cross @ self.weights.imag)
        return mean.to(torch.complex64).reshape(len(cross), *self.shape)

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        if self.site is None:
            raise ValueError("complex_gp: not fitted yet; call fit or restore first")
        if self.near is not None:
            arrays = {"places": self.places, "level": torch.from_numpy(self.near.level)}
            arrays |= {name: torch.from_numpy(getattr(self, name)) for name in ("targets", "count", "first")}
            stored = {**arrays, "shape": list(self.shape)}
            return {**stored, "length": self.length, "noise": self.noise, "power": self.power}
        names = ("places", "weights", "length", "noise", "power", "turned")
        own = {"factor": self.factor.lower, **{name: getattr(self, name) for name in names}}
        return {**own, **self.runs.state(), "shape": list(self.shape)}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.shape = site, tuple(int(n) for n in state["shape"])
        self.length, self.noise, self.power = (float(state[k]) for k in ("length", "noise", "power"))
        self.places, self.near = state["places"], None
        if "level" in state:
            self.near = Neighbourhood(self.places.numpy(), state["level"].numpy())
            self.targets = state["targets"].numpy()
            self.count, self.first = state["count"].numpy(), state["first"].numpy()
            self.runs = RunFactors.none()
            return
        self.weights, self.factor = state["weights"], Factor(state["factor"])
        self.turned, self.runs = state["turned"], RunFactors.read(state)

    def size(self) -> int:
        """Training samples kept."""
        return len(self.places) if self.site is not None else 0
