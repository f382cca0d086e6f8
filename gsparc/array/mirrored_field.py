"""Mirrored arrays as a method: found in recovered vectors, trained through the spectrum, pruned.

For scenes with few reflections off bare walls. Its sources are places and mirrors, so that it speaks where
nobody measured; what they do not explain is an incoherent share of the mean spectrum.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.array.mirrored import MirroredArrays
from gsparc.array.process import Kernel, learn_process, mirror_elements
from gsparc.array.render import SpectrumRenderer
from gsparc.array.response import site_problem
from gsparc.array.search import PROGRESS, SearchSettings, explained, find_sources
from gsparc.array.store import recovered, report
from gsparc.baselines import platform_cache
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.losses import spectrum_loss
from gsparc.method import FitReport, Method, Prediction
from gsparc.ops import Pose
from gsparc.peers.encoding import to_real, training_targets

log = logging.getLogger(__name__)

QUERY_CHUNK = 64


@dataclass(frozen=True)
class TuningSettings:
    """End-to-end training through `|A^H h|` and the normalisation.

    Attributes:
        steps: of Adam.
        batch: spectra per step.
        rate: of positions [m]; turns and gains follow in proportion.
        least_share: sources with a smaller share of the power are pruned before and after.
    """

    steps: int = 200
    batch: int = 8
    rate: float = 0.005
    least_share: float = 1e-4


class MirroredField(Method):
    """Reflections as mirrored arrays.

    Args:
        search: how sources are looked for; their number is chosen on validation rows.
        tuning: how they are trained through the spectrum.
        rows: largest number of training spectra used.
        cache: keep recovered vectors on disk.
        seed: of every random choice.
        name: as it appears in tables.
    """

    effects = "array"

    def __init__(
        self,
        search: SearchSettings | None = None,
        tuning: TuningSettings | None = None,
        rows: int = 128,
        cache: bool = True,
        seed: int = 0,
        name: str = "array_mirrored",
    ) -> None:
        self.search, self.tuning = search or SearchSettings(), tuning or TuningSettings()
        self.rows, self.cache, self.seed, self.name = rows, cache, seed, name
        self.site: Site | None = None
        self.model: MirroredArrays | None = None
        self.renderer: SpectrumRenderer | None = None
        self.background: Tensor | None = None
        self.share = 0.0

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Recover, search, train, prune; the seconds include the recovery as it was first measured.

        Raises:
            ValueError: the site's spectra have no array to go through, or no known receiver.
        """
        problem = site_problem(data.site)
        if problem is None and (data.site.static_position is None or data.site.rx_rotation is None):
            problem = "the receiver's pose is unknown"
        if problem is None and len(fold.train) < 2:
            problem = "the training set is empty"
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        generator = np.random.default_rng([self.seed, 5])
        train = np.sort(generator.permutation(fold.train)[: self.rows])
        rows = np.concatenate([train, fold.val])
        found, recovery_s = recovered(
            data, np.sort(rows), platform_cache() if self.cache else None, self.seed
        )
        report(found, data, np.sort(rows), run_dir / "array_recovery.csv")
        begin = time.perf_counter()
        vectors = found.vectors[np.argsort(np.argsort(rows))]
        self._learn(data, rows, len(train), vectors)
        return FitReport(recovery_s + time.perf_counter() - begin, (f"{self.name}: {self.size()} sources",))

    def _learn(self, data: Measurements, rows: np.ndarray, train: int, vectors: np.ndarray) -> None:
        site = data.site
        assert site.grid is not None and site.array is not None and site.wavelength is not None
        assert site.static_position is not None and site.rx_rotation is not None
        partner = mirror_elements(site.array)
        settled = learn_process(vectors, data.tx[rows], partner, Kernel(site.wavelength / 3, 0.01)).vectors
        readings = [settled] if partner is None else [settled, settled.conj()[:, partner]]
        x, array = torch.from_numpy(data.tx[rows]), torch.from_numpy(site.array)
        receiver = (torch.from_numpy(site.static_position), torch.from_numpy(site.rx_rotation))
        cut = train if train < len(rows) else 0  # without validation rows the training rows judge
        models = []
        for reading in (torch.from_numpy(r) for r in readings):
            model = find_sources(
                array, site.wavelength, receiver, x[:train], reading[:train],
                (x[cut:], reading[cut:]), self.search, self.seed,
            )  # fmt: skip
            with torch.no_grad():
                unit = reading / torch.linalg.vector_norm(reading, dim=1, keepdim=True).clamp_min(1e-30)
                models.append((float(explained(model(x[cut:]), unit[cut:]).mean()), model))
        # Of two readings that explain about as much, the one with fewer sources is the right one.
        score, model = max(models, key=lambda pair: pair[0] - PROGRESS * len(pair[1].positions))
        images = torch.from_numpy(to_real(training_targets(data, rows), "spectrum"))
        log.info("%s: %.1f %% of the judged vectors explained", self.name, 100 * score)
        self.site = site
        self.background = images.mean(0).view(site.grid.height, site.grid.width)
        self.renderer = SpectrumRenderer(site, self.background)
        self.model = model.pruned(x, self.tuning.least_share)
        self._tune(x[:train], images[:train].view(-1, *self.background.shape))
        self.model = self.model.pruned(x, self.tuning.least_share).requires_grad_(False)
        self.share = self._best_share(x[cut:], images[cut:].view(-1, *self.background.shape))

    @torch.no_grad()
    def _best_share(self, x: Tensor, images: Tensor) -> float:
        """The incoherent share of least squared error on the judged spectra."""
        errors = {}
        for share in np.linspace(0, 1, 21):
            self.share = float(share)
            errors[self.share] = float((self._spectra(x) - images).square().mean())
        return min(errors, key=errors.__getitem__)

    def _tune(self, x: Tensor, images: Tensor) -> None:
        assert self.model is not None
        model, settings = self.model, self.tuning
        scale = float(model.gains.detach().abs().mean())
        optimizer = torch.optim.Adam(
            [
                {"params": [model.positions], "lr": settings.rate},
                {"params": [model.turns], "lr": settings.rate / 10},
                {"params": [model.gains], "lr": settings.rate * scale},
            ]
        )
        schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, max(1, settings.steps))
        generator = torch.Generator().manual_seed(self.seed)
        for _ in range(settings.steps):
            rows = torch.randint(len(x), (settings.batch,), generator=generator)
            optimizer.zero_grad()
            spectrum_loss(self._spectra(x[rows]), images[rows]).mean().backward()
            model.hold_first()
            optimizer.step()
            schedule.step()

    def _spectra(self, x: Tensor) -> Tensor:
        """Spectra (B, H, W): the coherent part divided by its maximum, and the share of the mean spectrum."""
        assert self.model is not None and self.renderer is not None and self.background is not None
        h = self.model(x)
        h = h / torch.linalg.vector_norm(h, dim=1, keepdim=True).clamp_min(1e-30)
        field = self.renderer(torch.cat([h, torch.zeros_like(h[:, :1])], 1).to(torch.complex64))
        field = field / field.amax((1, 2), keepdim=True)
        kept, left = 1 - self.share**2, self.share**2
        return (kept * field.square() + left * self.background.square()).clamp_min(1e-12).sqrt()

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """Predict at tx (B, 3) [m]; the receiver is the one that was measured with.

        Raises:
            RuntimeError: before `fit` or `restore`.
        """
        if self.model is None:
            raise RuntimeError(f"{self.name} has not been trained: call fit() or load a checkpoint")
        return Prediction(torch.cat([self._spectra(part.double()) for part in tx.split(QUERY_CHUNK)]))

    def state(self) -> dict[str, Any]:
        """Sources, background, share."""
        assert self.model is not None
        return {"sources": self.model.state_dict(), "background": self.background, "share": self.share}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        assert site.array is not None and site.wavelength is not None
        count = len(state["sources"]["positions"])
        blank = (torch.zeros(count, 3), torch.zeros(count, 3, 3), torch.zeros(count))
        self.model = MirroredArrays(torch.from_numpy(site.array), site.wavelength, *blank)
        none = torch.zeros(count, dtype=torch.bool)  # files written before there were scatterers
        self.model.load_state_dict({"scattering": none, **state["sources"]})
        self.model.requires_grad_(False)
        self.site, self.background, self.share = site, state["background"], float(state["share"])
        self.renderer = SpectrumRenderer(site, self.background)

    def size(self) -> int:
        """Number of sources."""
        return 0 if self.model is None else len(self.model.positions)
