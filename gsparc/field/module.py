"""LightningModules: of any model that answers queries, and of Gaussians that are rendered."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import lightning.pytorch as L
import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Batch
from gsparc.data.schema import Site
from gsparc.field import edit
from gsparc.field.confidence import weighted_loss
from gsparc.field.distributed import process_count
from gsparc.field.losses import LossSettings, fits_ssim_window, squared_error, ssim, task_loss
from gsparc.field.model import GaussianModel, Rendered
from gsparc.field.optimizer import OptimizerSettings, RateOf, optimizer_for, scheduler_for
from gsparc.ops import UnsoundGaussian
from gsparc.physics.decibels import to_decibels


class NonFiniteLoss(RuntimeError):
    """Training met a NaN or an infinity; batch and parameters are on disk."""


class StepLosses(NamedTuple):
    """The loss () of a step on a batch, and the task's of each sample (B,) where told apart."""

    step: Tensor
    by_sample: Tensor


class NetworkModule(L.LightningModule):
    """Trains a network by its own loss.

    Args:
        model: called with a query, gives targets (B, ...); `loss(batch, draw)` is () of a batch,
            with a generator for what is drawn at random.
        site: what the data declare.
        rates: of its schedule, and of its parameters where `rate_of` does not say.
        total_steps: length of the schedules.
        run_dir: where a poisoned batch is left.
        rate_of: see `optimizer_for`.
    """

    count: int | None = None  # of Gaussians that callbacks may edit

    def __init__(
        self,
        model: Any,
        site: Site,
        rates: OptimizerSettings,
        total_steps: int,
        run_dir: Path,
        rate_of: RateOf | None = None,
    ) -> None:
        super().__init__()
        self.model, self.site, self.rates, self.rate_of = model, site, rates, rate_of
        self.total_steps, self.run_dir = total_steps, run_dir
        self.prepared_seconds = 0.0  # before the first step; the learning curve starts there
        self.train_seconds = 0.0  # written by the cost ledger
        self.solved = False  # whether training starts from emissions in closed form
        self.start = "start"  # what the learning curve calls its first point
        self.log_every = 1  # steps; a figure costs as much as a kernel to log
        # Squared error of each validation row (n,), at the last look
        self.held_out = torch.zeros(0)
        self.figures: dict[str, float] = {}  # of all validation rows, at the last look
        self._looks: list[tuple[Tensor, dict[str, Tensor]]] = []
        # Of the current step; evidence when it poisons the parameters
        self.batch: Batch | None = None

    def mean(self, batch: Batch) -> Tensor:
        """Return targets (B, ...) as predicted."""
        return self.model(batch)

    def losses(self, batch: Batch) -> StepLosses:
        """Return the losses of a step."""
        # Draws are a pure function of (seed, step): a resumed run goes on with the same.
        draw = torch.Generator().manual_seed(torch.initial_seed() + self.global_step)
        loss = self.model.loss(batch, draw)
        return StepLosses(loss, loss.expand(len(batch)))

    def training_step(self, batch: Batch, step: int) -> Tensor:
        """Return the loss of a batch; one that is not finite ends training."""
        self.batch = batch
        loss, task = self.losses(batch)
        if not torch.isfinite(loss):
            bad = ~torch.isfinite(task)
            raise self._write_evidence(
                batch, int(batch.index[bad][0] if bad.any() else batch.index[0])
            )
        if (self.global_step + 1) % self.log_every == 0:
            part = batch.share * process_count()  # the mean over processes is that over the batch
            self.log("train/task_loss", task.detach().mean() * part, sync_dist=True)
            # weighted by the confidence, where there is one
            self.log("train/loss", loss.detach() * part, sync_dist=True)
            if self.count is not None:
                self.log("model/num_gaussians", float(self.count))
        return loss * batch.share

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Log rates of the step that was taken, by names
        of their settings (`OptimizerSettings`).
        """
        if self.global_step % self.log_every == 0:
            groups = self.trainer.optimizers[0].param_groups
            self.log_dict({f"rate/{group['kind']}": group["lr"] for group in groups})

    def validation_step(self, batch: Batch, step: int) -> None:
        """Log validation figures."""
        mean = self.mean(batch)
        if batch.mask is not None:
            mean = torch.where(batch.mask, mean, batch.target)
        size = len(batch)
        errors = squared_error(mean, batch, self.site.target)
        figures = {"val/error": errors.mean()}
        error = (mean - batch.target).abs().square().flatten(1).mean(1)
        if not self.site.target.is_image:
            figures["val/mse"] = error.mean()
        else:
            if fits_ssim_window(mean):
                figures["val/ssim_gauss"] = ssim(mean, batch.target).mean()
            figures["val/psnr_db"] = -to_decibels(error.clamp_min(1e-12)).mean()
        self._looks.append((errors, figures))
        self.log_dict(figures, batch_size=size, prog_bar=True)
        # Dashboards get the seconds beside every figure too.
        self.log("time/train_s", self.prepared_seconds + self.train_seconds, batch_size=size)

    def on_validation_epoch_end(self) -> None:
        """Keep the errors of all rows and their figures:
        Lightning drops those of the look before step 1.
        """
        looks, self._looks = self._looks, []
        if not looks:
            return
        self.held_out = torch.cat([errors for errors, _ in looks]).double().cpu()
        rows = [len(errors) for errors, _ in looks]
        self.figures = {
            name: float(np.average([float(figures[name]) for _, figures in looks], weights=rows))
            for name in looks[0][1]
        }

    def predict_step(self, batch: Batch, step: int) -> Tensor:
        """Return targets (B, ...) in stored units, spectra within [0, 1]."""
        mean = self.mean(batch)
        return mean.clamp(0, 1) if self.site.target.is_image else mean

    def test_step(self, batch: Batch, step: int) -> None:
        """Log the squared error of test rows; `gsparc evaluate` has all figures."""
        error = squared_error(self.mean(batch), batch, self.site.target).mean()
        self.log("test/error", error, batch_size=len(batch))

    @classmethod
    def load_from_checkpoint(cls, *_: Any, **__: Any) -> NoReturn:  # type: ignore[override]
        """Raise `NotImplementedError`, which says what reads our checkpoints:
        they hold whole models.
        """
        raise NotImplementedError(
            "a checkpoint holds a whole model: say gsparc.models.loading.load_module(FILE)"
        )

    def configure_optimizers(self) -> Any:
        """Return one Adam group per tensor, rates as pure functions of the step."""
        optimizer = optimizer_for(self.model, self.rates, self.rate_of)
        scheduler = scheduler_for(optimizer, self.rates, self.total_steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a poisoned state, which must never replace a good checkpoint."""
        if self._find_nonfinite() is not None and self.batch is not None:
            raise self._write_evidence(self.batch, int(self.batch.index[0]))

    def _find_nonfinite(self) -> str | None:
        """The first parameter that is not finite; None when all are."""
        bad = (name for name, p in self.model.named_parameters() if not torch.isfinite(p).all())
        return next(bad, None)

    def _write_evidence(
        self, batch: Batch, sample: int, refused: str | None = None
    ) -> NonFiniteLoss:
        """Leave batch, parameters and the first offender on disk; the error that says so."""
        path = self.run_dir / "nonfinite.pt"
        path.parent.mkdir(parents=True, exist_ok=True)
        offender = self._find_nonfinite() or refused
        evidence = {
            **{"step": self.global_step, "sample": sample, "offender": offender},
            **{"index": batch.index, "tx": batch.tx, "target": batch.target, "mask": batch.mask},
            **{"rx_position": batch.rx.position, "rx_rotation": batch.rx.rotation},
        }
        torch.save({**evidence, "state_dict": self.model.state_dict()}, path)
        culprit = (
            f"first offender: {offender}"
            if offender
            else ("all parameters are finite, see the batch")
        )
        return NonFiniteLoss(
            f"the loss became NaN or infinite at step {self.global_step} (sample {sample}; "
            f"{culprit}); "
            f"batch and parameters are in {path}"
        )


class GaussianModule(NetworkModule):
    """Trains a Gaussian field by rendering.

    Args:
        model: what is trained.
        loss: task loss.
        optimizer: learning rates.
        total_steps: length of the schedules.
        run_dir: where a poisoned batch is left.
    """

    def __init__(
        self,
        model: GaussianModel,
        loss: LossSettings,
        optimizer: OptimizerSettings,
        total_steps: int,
        run_dir: Path,
    ) -> None:
        super().__init__(model, model.site, optimizer, total_steps, run_dir)
        self.loss = loss
        # Of the current step; densification reads its gradients
        self.rendered: Rendered | None = None

    @property
    def count(self) -> int:  # type: ignore[override]
        """Number of Gaussians."""
        return len(self.model.gaussians)

    def mean(self, batch: Batch) -> Tensor:
        """See `NetworkModule`."""
        return self._render(batch).mean

    def losses(self, batch: Batch) -> StepLosses:
        """See `NetworkModule`; weighted by the confidence, where there is one."""
        self.rendered = self._render(batch)
        task = self.task_loss(self.rendered.mean, batch)
        confidence = self.model.confidence
        if confidence is None:
            return StepLosses(task.mean(), task)
        exponent = confidence.exponent(self.site.moving(batch.tx, batch.rx))
        return StepLosses(weighted_loss(task, exponent, confidence.settings.alpha).mean(), task)

    def task_loss(self, prediction: Tensor, batch: Batch) -> Tensor:
        """Return the loss per sample (B,) before confidence;
        what was not measured counts as met.
        """
        return task_loss(prediction, batch, self.loss, self.site.target)

    def _render(self, batch: Batch) -> Rendered:
        try:
            return self.model(batch.tx, batch.rx)
        except UnsoundGaussian as refused:  # a NaN, an infinity, or what would overflow to one
            row = int(self.model.gaussians.ids[refused.index])
            raise self._write_evidence(
                batch, int(batch.index[0]), f"Gaussian id {row}: {refused}"
            ) from refused

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """Make room for the number of Gaussians before their tensors arrive."""
        edit.resize_gaussians(
            self.model, self.model.gaussians, len(state_dict["model.gaussians.ids"])
        )
        return super().load_state_dict(state_dict, *args, **kwargs)

    def _find_nonfinite(self) -> str | None:
        """See `NetworkModule`; with the id of the Gaussian."""
        name = super()._find_nonfinite()
        if name not in edit.row_parameters(self.model, self.count):
            return name
        bad = ~torch.isfinite(self.model.get_parameter(name))
        return f"Gaussian id {int(self.model.gaussians.ids[int(bad.nonzero()[0, 0])])}, {name}"
