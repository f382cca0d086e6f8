"""Sources with carrier phase are pruned by their share of power: they do not occlude."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.field import edit
from gsparc.field.response import PathResponse

log = logging.getLogger(__name__)


@dataclass(eq=False)
class ContributionPruning(L.Callback):
    """Drop sources whose share of the power at the training rows is small; only where there is carrier phase.

    Args:
        interval: steps between prunings.
        least_share: of the power; the strongest source always stays.
    """

    interval: int = 100
    least_share: float = 1e-4

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Prune when the schedule says so."""
        model = module.model
        if (
            module.conditional
            or not isinstance(model.response, PathResponse)
            or trainer.global_step % self.interval
        ):
            return
        data = trainer.datamodule  # type: ignore[attr-defined]
        batch = data.measurements.batch(data.fold.train).to(module.device)
        with torch.no_grad():
            gains = torch.view_as_complex(model.features(batch.tx, batch.rx).contiguous())
            share = model.response.contributions(gains, model.gaussians.means, batch.rx)
            keep = (share >= self.least_share) | (share == share.max())
            if keep.all():
                return
            none = torch.empty(0, dtype=torch.long)
            edit.apply(edit.Edit(keep, none), model, model.gaussians, trainer.optimizers[0])
        log.info("step %d: kept %d of %d sources", trainer.global_step, int(keep.sum()), len(keep))
