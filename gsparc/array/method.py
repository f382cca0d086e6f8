"""`model=array`, spectra of a static array: phase retrieval, Gaussian process, wave-packet query model."""

from __future__ import annotations

import copy
import logging
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.array.cross_validation import MIN_VARIANCE, LeftOut, compared, tune
from gsparc.array.phase_retrieval import recover
from gsparc.array.vector_cache import recovered, report
from gsparc.array.vector_gp import fit_vector_gp, mirror_elements
from gsparc.array.wave_packets import PacketSettings, WavePackets, distil
from gsparc.data.files import platform_cache
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.coarse_grid import Filled, coarser
from gsparc.methods.method import FitContext, FitReport, Method, Prediction, PredictsVariance
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import MeanOnly
from gsparc.methods.target_rows import to_real, training_targets
from gsparc.methods.time_budget import TimeBudget
from gsparc.ops import Pose
from gsparc.physics.array_response import steering
from gsparc.physics.bartlett import SpectrumRenderer

log = logging.getLogger(__name__)

ARRAY_SHARE = 0.75  # of the probed images that the declared array must be able to have measured
QUERY_CHUNK = 4  # spectra rendered at a time: they stay in the CPU cache


class ArrayField(PredictsVariance):
    """The complex field at a static array as a function of the transmitter's position.

    Args:
        packets: number and shape of the packets.
        rows: largest number of training spectra; more are subsampled with the seed.
        refit: train on validation rows too (settings are chosen by cross-validation, not on them).
        cache: keep recovered vectors on disk.
        seed: of every random choice.
        name: as it appears in tables.
    """

    effects = "array"

    def __init__(
        self,
        packets: PacketSettings | None = None,
        rows: int = 5000,
        refit: bool = True,
        cache: bool = True,
        seed: int = 0,
        name: str = "array",
    ) -> None:
        self.packets = packets or PacketSettings()
        self.rows, self.refit, self.cache, self.seed, self.name = rows, refit, cache, seed, name
        self.site: Site | None = None
        self.field: WavePackets | None = None
        self.renderer: SpectrumRenderer | None = None
        self.background: Tensor | None = None
        self.error = (0.0, 0.0)
        self.seen = 0
        self.left_out: LeftOut | None = None  # set by `fit`, not stored

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Retrieve the phases of the training rows, fit the vector GP, distil it into wave packets.

        The seconds include phase retrieval, also when it is read from the cache (then as first measured).

        Raises:
            ValueError: the site declares no usable array, or the training set is empty.
        """
        if data.site.array_problem is not None:
            raise ValueError(f"{self.name}: {data.site.array_problem}")
        rows = np.sort(np.concatenate([fold.train, fold.val])) if self.refit else fold.train
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        watch = TimeBudget()
        if len(rows) > self.rows:
            rows = np.sort(np.random.default_rng([self.seed, 5]).permutation(rows)[: self.rows])
            log.info("%s: training on %d of the spectra", self.name, len(rows))
        found, recovery = recovered(data, rows, platform_cache() if self.cache else None, self.seed)
        elapsed, recovery_s = watch.spent, recovery.wall
        report(found, data, rows, context.run_dir / "array_recovery.csv")
        watch = TimeBudget()
        self._learn(data, rows, found.vectors)
        seconds = recovery_s + watch.spent
        notes = [
            f"{self.name}: phase retrieval {recovery_s:.1f} s (this run {elapsed:.1f} s), training "
            f"{seconds - recovery_s:.1f} s, {int(found.suspect.sum())} suspect spectra"
        ]
        return FitReport(seconds, tuple(notes), "processor" if found.time_limited.any() else None)

    def _learn(self, data: Measurements, rows: np.ndarray, vectors: np.ndarray) -> None:
        site = data.site
        assert site.grid is not None and site.array is not None and site.wavelength is not None
        images = to_real(training_targets(data, rows), "spectrum")
        matrix = steering(site.array, site.grid, site.wavelength).numpy()
        partner, places = mirror_elements(site.array), data.tx[rows]
        tuned = tune(vectors, places, images, matrix, site.wavelength, partner, self.seed)
        log.info(
            "%s: length %.3g m, noise %.2g of the field's variance",
            self.name, tuned.kernel.length, tuned.kernel.noise,
        )  # fmt: skip
        teacher = fit_vector_gp(vectors, places, partner, tuned.kernel)
        self.site, self.seen, self.error = site, len(rows), tuned.error_model()
        self.left_out = tuned.left_out
        self.field = distil(teacher, self.packets, site.wavelength, self.seed).requires_grad_(False)
        self.background = torch.from_numpy(images.mean(0)).view(site.grid.height, site.grid.width)
        self.renderer = SpectrumRenderer(*site.array_geometry(), self.background)

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """Predict at tx (B, 3) [m]; the receiver is the one that was measured with.

        The confidence is the share of the squared error expected far from all data that is not expected here;
        both come from training spectra predicted without their neighbours.

        Raises:
            RuntimeError: before `fit` or `restore`.
        """
        if self.field is None or self.renderer is None:
            raise RuntimeError(f"{self.name} has not been trained: call fit() or load a checkpoint")
        mean = torch.empty(len(tx), *self.renderer.square.shape)
        unknown = torch.empty(len(tx))
        with torch.inference_mode():  # the results are ordinary tensors, made before
            for start in range(0, len(tx), QUERY_CHUNK):
                part = slice(start, start + QUERY_CHUNK)
                vectors = self.field(tx[part])
                torch.square(vectors[:, -1].real, out=unknown[part])
                self.renderer.draw(vectors, mean[part])
        share = ((unknown + MIN_VARIANCE) / (1 + MIN_VARIANCE)) ** self.error[1]
        far = self.error[0] * (1 + MIN_VARIANCE) ** self.error[1]
        return Prediction(mean, 1 - share, far * share)

    def explains(self, data: Measurements, rows: np.ndarray, seed: int) -> tuple[bool, str]:
        """See `Explains`: whether vectors of one number per element make the images of rows (n,)."""
        found = recover(data.site, data.target[rows], data.moving[rows], seed=seed)
        share = 1 - float(found.suspect.mean())
        assert data.site.array is not None
        elements = len(data.site.array)
        reason = f"{share:.0%} of {len(rows)} probed images are explained by {elements} complex numbers each"
        return share >= ARRAY_SHARE, reason

    def compared_with_gp(self) -> tuple[float, float] | None:
        """See `ComparesWithGP`."""
        return None if self.left_out is None else compared(self.left_out)

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        return ("keep", "stride", "confidence")

    @torch.no_grad()
    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """`contribution` (N,): the mean power each packet adds at training rows (n,).

        `places` (n, 3) [m]: those rows' positions, where fewer packets learn what all of them predict.
        """
        assert self.field is not None
        places = torch.from_numpy(data.moving[rows].astype(np.float32))
        features = self.field.features(places)
        power = (features.square().mean(0) * self.field.gains.square().sum(1)).view(2, -1).sum(0)
        return {"contribution": power, "places": places}

    @torch.no_grad()
    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`: fewer packets (`keep`, a share) on fewer pixels (`stride`)."""
        assert self.field is not None and self.site is not None and self.background is not None
        twin, stride = copy.copy(self), int(settings.get("stride", 1))
        if "keep" in settings:
            share, contribution = float(settings["keep"]), measured["contribution"]
            twin.field = self.field.strongest(share, contribution, measured["places"])
        found: Method = twin
        if stride > 1:
            array, grid, wavelength = self.site.array_geometry()
            background = self.background[::stride, ::stride]
            twin.renderer = SpectrumRenderer(array, coarser(grid, stride), wavelength, background)
            found = Filled(twin, grid, stride)
        return found if settings.get("confidence", True) else MeanOnly(found)

    def state(self) -> dict[str, Any]:
        """Packets, background, error model."""
        assert self.field is not None
        return {
            "packets": self.field.state_dict(),
            "elements": self.field.elements,
            "background": self.background,
            "error": list(self.error),
            "seen": self.seen,
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        stored = state["packets"]
        count = len(stored["gains"]) // 2
        blank = (torch.zeros(count, 3), torch.ones(count), torch.zeros(count, 3), torch.zeros(3))
        self.field = WavePackets(*blank, elements=int(state["elements"])).requires_grad_(False)
        self.field.load_state_dict(stored)
        self.site, self.background, self.seen = site, state["background"], int(state["seen"])
        self.error = (float(state["error"][0]), float(state["error"][1]))
        self.renderer = SpectrumRenderer(*site.array_geometry(), self.background)

    def size(self) -> int:
        """Number of packets."""
        return 0 if self.field is None else len(self.field.gains) // 2
