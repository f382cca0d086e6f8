"""Pictures of measured beside predicted targets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.drawing import panels, save
from gsparc.methods.method import Method

SPECTRA = 4  # test rows drawn


def draw_predictions(method: Method, data: Measurements, fold: Fold, title: str, path: Path) -> None:
    """Draw test rows: `SPECTRA` spectra, or all channels or powers as points.

    Args:
        method: fitted on `fold`.
        data, fold: where the test rows come from.
        title: above everything.
        path: PNG file.
    """
    spectra = data.site.kind == "spectrum"
    few = np.linspace(0, len(fold.test) - 1, min(SPECTRA, len(fold.test))).astype(int)
    rows = fold.test[few] if spectra else fold.test
    batch = data.batch(rows)
    found = method.answer(batch)
    true, predicted = batch.target.numpy(), found.mean.numpy()
    if not spectra:
        return draw_points(true, predicted, title, path)
    confidence = None if found.confidence is None else found.confidence.numpy()
    return draw_spectra(true, predicted, rows, title, path, confidence)


def draw_points(target: np.ndarray, predicted: np.ndarray, title: str, path: Path) -> None:
    """Save a figure of predicted against measured strength, and of the error of the phase where there is one.

    Args:
        target, predicted: (B, ...) complex channels or real powers, in stored units.
        title: above everything.
        path: PNG file.
    """
    channels = np.iscomplexobj(target)
    figure, (axes,) = panels(11 if channels else 5.5, 4.6, 1, 2 if channels else 1, grid=False)
    tiny, factor = np.finfo(np.float32).tiny, 20 if channels else 10
    true_db, guess_db = (factor * np.log10(np.maximum(np.abs(x).ravel(), tiny)) for x in (target, predicted))
    low, high = np.percentile(true_db, [0.5, 100])
    axes[0].plot([low, high], [low, high], color="grey", linewidth=1)
    axes[0].scatter(true_db, guess_db, s=6, alpha=0.5)
    axes[0].set(
        xlim=(low - 3, high + 3), ylim=(low - 3, high + 3), xlabel="measured [dB]", ylabel="predicted [dB]"
    )
    axes[0].set_title("strength, relative to unit power")
    if channels:
        turn = np.degrees(np.angle(predicted.ravel() * target.ravel().conj()))
        axes[1].scatter(true_db, turn, s=6, alpha=0.5)
        axes[1].set(xlabel="measured strength [dB]", ylabel="phase error [degrees]", ylim=(-180, 180))
        axes[1].set_title(f"phase error, median {np.median(np.abs(turn)):.1f} degrees")
    figure.suptitle(title)
    save(figure, path, 90)


def draw_spectra(
    target: np.ndarray,
    predicted: np.ndarray,
    rows: np.ndarray,
    title: str,
    path: Path,
    confidence: np.ndarray | None = None,
) -> None:
    """Save a figure: a line per sample, with measured, predicted and difference beside each other.

    Args:
        target, predicted: (B, H, W) in [0, 1].
        rows: (B,) dataset rows, for the labels.
        title: above everything.
        path: PNG file.
        confidence: (B,) in [0, 1], written into the predictions.
    """
    height = 1.6 * len(target) + 0.9
    figure, axes = panels(13, height, len(target), 3, grid=False, sharex=True, sharey=True)
    options: dict[str, Any] = {"origin": "lower", "aspect": "auto"}
    options["extent"] = (0, target.shape[2], 0, target.shape[1])
    for number, (line, true, guess, row) in enumerate(zip(axes, target, predicted, rows, strict=True)):
        power = line[0].imshow(true, vmin=0, vmax=1, cmap="inferno", **options)
        line[1].imshow(guess, vmin=0, vmax=1, cmap="inferno", **options)
        error = line[2].imshow(guess - true, vmin=-0.5, vmax=0.5, cmap="RdBu_r", **options)
        line[0].set_ylabel(f"sample {row}\nelevation row")
        corner = {"x": 0.99, "y": 0.95, "ha": "right", "va": "top"}
        if confidence is not None:
            said = f"confidence {confidence[number]:.2f}"
            line[1].text(s=said, color="white", transform=line[1].transAxes, **corner)
        rms = np.sqrt(np.mean((guess - true) ** 2))
        line[2].text(s=f"rms {rms:.3f}", transform=line[2].transAxes, **corner)
    for axis, name in zip(axes[0], ("measured", "predicted", "predicted - measured"), strict=True):
        axis.set_title(name)
    for axis in axes[-1]:
        axis.set_xlabel("azimuth column")
    figure.colorbar(power, ax=axes[:, 1], label="relative strength")
    figure.colorbar(error, ax=axes[:, 2], label="difference")
    figure.suptitle(title)
    save(figure, path, 80)
