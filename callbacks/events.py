"""Events of training as figures of the trackers."""

from __future__ import annotations

from collections.abc import Mapping

import lightning.pytorch as L


def noted(trainer: L.Trainer, module: L.LightningModule, figures: Mapping[str, float]) -> None:
    """Give the loggers the figures of an event, at the number of steps taken, not the schedule's."""
    for logger in trainer.loggers:
        logger.log_metrics(dict(figures), step=module.global_step)
