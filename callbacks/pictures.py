"""Predicted against true spectra, drawn now and then and at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gsparc.callbacks.ledger import CostLedger


class Pictures(L.Callback):
    """Draw a few validation rows (training rows where there are none): measured, predicted, difference.

    Args:
        every: steps between pictures; the last step is always drawn.
        count: number of rows drawn.
    """

    def __init__(self, every: int = 1000, count: int = 4) -> None:
        self.every = every
        self.count = count

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Draw when it is time."""
        step = trainer.global_step
        if (step % self.every and step != trainer.max_steps) or module.model.site.kind != "spectrum":
            return
        data = trainer.datamodule  # type: ignore[attr-defined]
        candidates = data.fold.val if len(data.fold.val) else data.fold.train
        rows = candidates[np.linspace(0, len(candidates) - 1, min(self.count, len(candidates))).astype(int)]
        with CostLedger.paused_in(trainer), torch.no_grad():
            batch = data.measurements.batch(rows).to(module.device)
            predicted = module.model(batch.tx, batch.rx).mean
            title = f"step {step}, {module.train_seconds:.0f} s of training"
            path = module.run_dir / "pictures" / f"step_{step:06d}.png"
            draw_spectra(batch.target.cpu().numpy(), predicted.cpu().numpy(), rows, title, path)


def draw_spectra(target: np.ndarray, predicted: np.ndarray, rows: np.ndarray, title: str, path: Path) -> None:
    """Save a figure: a line per sample, with measured, predicted and difference beside each other.

    Args:
        target, predicted: (B, H, W) in [0, 1].
        rows: (B,) dataset rows, for the labels.
        title: above everything.
        path: PNG file.
    """
    figure = Figure(figsize=(13, 1.6 * len(target) + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(target), 3, squeeze=False, sharex=True, sharey=True)
    for line, (true, guess, row) in enumerate(zip(target, predicted, rows, strict=True)):
        options: dict[str, Any] = {"origin": "lower", "aspect": "auto"}
        options["extent"] = (0, true.shape[1], 0, true.shape[0])
        power = axes[line, 0].imshow(true, vmin=0, vmax=1, cmap="inferno", **options)
        axes[line, 1].imshow(guess, vmin=0, vmax=1, cmap="inferno", **options)
        error = axes[line, 2].imshow(guess - true, vmin=-0.5, vmax=0.5, cmap="RdBu_r", **options)
        axes[line, 0].set_ylabel(f"sample {row}\nelevation row")
        axes[line, 2].text(
            0.99, 0.95, f"rms {np.sqrt(np.mean((guess - true) ** 2)):.3f}", ha="right", va="top",
            transform=axes[line, 2].transAxes,
        )  # fmt: skip
    for axis, name in zip(axes[0], ("measured", "predicted", "predicted - measured"), strict=True):
        axis.set_title(name)
    for axis in axes[-1]:
        axis.set_xlabel("azimuth column")
    figure.colorbar(power, ax=axes[:, 1], label="relative power")
    figure.colorbar(error, ax=axes[:, 2], label="difference")
    figure.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
