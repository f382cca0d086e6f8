"""The learned Gaussian field as a method: fit with Lightning, predict from a frozen plan."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.loggers import Logger
from torch import Tensor

from gsparc import surgery
from gsparc.data.module import MeasurementsModule
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.encoding import Prior
from gsparc.method import FitReport, Method, Prediction
from gsparc.model import GaussianModel, ModelSettings
from gsparc.module import GaussianModule, LossSettings
from gsparc.ops import FrozenPlan, Pose
from gsparc.resume import GsparcCheckpointIO
from gsparc.schedule import OptimizerSettings
from gsparc.warmstart import learn_prior, warm_start

QUERY_CHUNK = 256  # bounds the memory of one prediction call


@dataclass(frozen=True)
class TrainerSettings:
    """How long and how training runs.

    Attributes:
        max_steps: optimiser steps.
        batch_size: samples per step.
        val_every: steps between validations.
        checkpoint_every: steps between `last.ckpt`.
        gradient_clip: largest gradient norm; null never clips.
        accelerator: Lightning's choice of device.
    """

    max_steps: int = 3000
    batch_size: int = 16
    val_every: int = 500
    checkpoint_every: int = 500
    gradient_clip: float | None = None
    accelerator: str = "cpu"


@dataclass
class Training:
    """What a run brings along; the method itself only knows how to learn.

    Attributes:
        settings: length and pace.
        seed: of initial parameters, data order and densification.
        callbacks: makes fresh Lightning callbacks.
        loggers: made once per run, closed by the caller.
        resume: checkpoint to go on from, or None.
        config_yaml: the whole configuration, stored in every checkpoint.
    """

    settings: TrainerSettings = field(default_factory=TrainerSettings)
    seed: int = 0
    callbacks: Callable[[], Sequence[L.Callback]] = tuple
    loggers: Sequence[Logger] = ()
    resume: Path | None = None
    config_yaml: str = ""


class LearnedField(Method):
    """A Gaussian field trained by gradient.

    Args:
        model: all switches of the model.
        loss: task loss.
        optimizer: learning rates.
        name: as it appears in tables.
        warm_start: solve the emission in closed form before training (spectra of a static receiver).
        guesses: settings the source of this configuration does not give, one line each.
    """

    def __init__(
        self,
        model: ModelSettings,
        loss: LossSettings,
        optimizer: OptimizerSettings,
        name: str = "gsparc",
        warm_start: bool = False,
        guesses: Sequence[str] = (),
    ) -> None:
        self.settings = model
        self.loss = loss
        self.rates = optimizer
        self.name = name
        self.warm_start = warm_start
        self.guesses = tuple(guesses)
        self.training = Training()
        self.model: GaussianModel | None = None
        self.site: Site | None = None
        self._ends: dict[str, Tensor] = {}
        self._prior: Prior | None = None
        self._frozen: FrozenPlan | None = None

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Train on `fold.train`; `fold.val` is watched and calibrates the confidence."""
        training, settings = self.training, self.training.settings
        L.seed_everything(training.seed, verbose=False)
        first = data.batch(fold.train[:1])
        self._ends = (
            {"rx_position": first.rx.position, "rx_rotation": first.rx.rotation}
            if data.site.static_end == "rx"
            else {"tx_position": first.tx[0]}
        )
        self.site = data.site
        started = time.perf_counter()
        if "kernel" in (self.settings.emission.encoding.kind, self.settings.confidence.encoding.kind):
            anchors = self.settings.emission.encoding.anchors
            self._prior = learn_prior(data, fold.train, anchors, training.seed)
        self.model = self._new_model(data.site)
        if self.warm_start and training.resume is None:
            if data.site.kind != "spectrum" or data.site.static_end != "rx" or self._prior is None:
                raise ValueError(
                    "model.warm_start=true needs spectra, a static receiver and encoding.kind=kernel"
                )
            warm_start(self.model, data, fold.train, first.rx, self._prior.noise)
        prepared = time.perf_counter() - started
        module = GaussianModule(self.model, self.loss, self.rates, settings.max_steps, run_dir)
        last = L.callbacks.ModelCheckpoint(
            run_dir, filename="last", every_n_train_steps=settings.checkpoint_every, save_top_k=1,
            save_on_train_epoch_end=False, enable_version_counter=False,
        )  # fmt: skip
        trainer = L.Trainer(
            accelerator=settings.accelerator,
            devices=1,
            max_steps=settings.max_steps,
            max_epochs=-1,
            callbacks=[*training.callbacks(), last],
            logger=list(training.loggers) or False,
            plugins=[GsparcCheckpointIO(self, training.config_yaml)],
            gradient_clip_val=settings.gradient_clip,
            val_check_interval=settings.val_every if len(fold.val) else None,
            check_val_every_n_epoch=None,
            limit_val_batches=None if len(fold.val) else 0,
            num_sanity_val_steps=0,
            enable_progress_bar=False,
            enable_model_summary=False,
            log_every_n_steps=50,
            default_root_dir=run_dir,
        )
        batches = MeasurementsModule(data, fold, settings.batch_size, training.seed)
        trainer.fit(module, datamodule=batches, ckpt_path=training.resume, weights_only=True)
        if trainer.interrupted:
            raise KeyboardInterrupt(f"training was interrupted; go on with ckpt_path={run_dir / 'last.ckpt'}")
        self._frozen = None
        self._calibrate(data, fold)
        return FitReport(prepared + module.train_seconds, self.guesses)

    def _new_model(self, site: Site) -> GaussianModel:
        ends = self._ends
        receiver = Pose(ends["rx_position"], ends["rx_rotation"]) if "rx_position" in ends else None
        return GaussianModel(self.settings, site, receiver, ends.get("tx_position"), self._prior)

    def _calibrate(self, data: Measurements, fold: Fold) -> None:
        model = self.fitted()
        rows = fold.val if len(fold.val) else fold.train
        if model.confidence is not None:
            model.confidence.calibrate(torch.from_numpy(np.asarray(data.moving[rows], dtype=np.float32)))

    # -- answering ---------------------------------------------------------------------------------

    def fitted(self) -> GaussianModel:
        """The trained model.

        Raises:
            RuntimeError: before `fit` or `restore`.
        """
        if self.model is None:
            raise RuntimeError(f"{self.name} has not been trained: call fit() or load a checkpoint")
        return self.model

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """Predict at tx (B, 3) [m] and one shared or B receiver poses."""
        model = self.fitted()
        if len(tx) > QUERY_CHUNK:
            parts = [
                self.predict(tx[i : i + QUERY_CHUNK], rx[i : i + QUERY_CHUNK] if rx.batched else rx)
                for i in range(0, len(tx), QUERY_CHUNK)
            ]
            confidence = None if parts[0].confidence is None else torch.cat([p.confidence for p in parts])  # type: ignore[misc]
            return Prediction(torch.cat([p.mean for p in parts]), confidence)
        static = model.site.kind == "spectrum" and model.site.static_end == "rx"
        if static and not rx.batched:
            mean = (
                self._frozen_plan(rx).render(model.features(tx, rx), int(model.gaussians.version)).squeeze(1)
            )
        else:
            mean = model(tx, rx).mean
        if model.site.kind == "spectrum":
            mean = mean.clamp(0, 1)
        if model.confidence is None:
            return Prediction(mean)
        return Prediction(mean, model.confidence.normalised(model.moving(tx, rx)))

    def _frozen_plan(self, rx: Pose) -> FrozenPlan:
        model = self.fitted()
        version = int(model.gaussians.version)
        if self._frozen is None or self._frozen.version != version:
            self._frozen = model.freeze(rx)
        return self._frozen

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs."""
        prior = None if self._prior is None else vars(self._prior)
        return {"ends": self._ends, "prior": prior, "model": self.fitted().state_dict()}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """Become the field whose `state()` this was."""
        self.site = site
        self._ends = dict(state["ends"])
        self._prior = None if state["prior"] is None else Prior(**state["prior"])
        self.model = self._new_model(site)
        surgery.resize(self.model, self.model.gaussians, len(state["model"]["gaussians.ids"]))
        self.model.load_state_dict(state["model"])
        self._frozen = None

    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.fitted().gaussians)
