"""Block error rates, throughput and the price of accepting more, drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.apps.link.adaptation import Rates
from gsparc.pictures.drawing import PALETTE, panels, save
from gsparc.processes.uncertainty import binomial_interval

STYLES = {
    "perfect@accepted": ("perfect, accepted", "black", "-"),
    "ls@accepted": ("LS from pilots, accepted", PALETTE[3], "-"),
    "lmmse@accepted": ("LMMSE pilots, accepted", PALETTE[2], "-"),
    "predicted@accepted": ("predicted, accepted", PALETTE[0], "-"),
    "predicted_pilots@accepted": ("prediction corrected by pilots, accepted", PALETTE[6], "-"),
    "perfect": ("perfect, all", "black", ":"),
    "ls": ("LS from pilots, all", PALETTE[3], ":"),
    "lmmse": ("LMMSE pilots, all", PALETTE[2], ":"),
    "predicted": ("predicted, all", PALETTE[1], ":"),
    "predicted_pilots": ("prediction corrected by pilots, all", PALETTE[6], ":"),
    "fallback": ("predicted, else pilots, all", PALETTE[4], "--"),
}
RATES = {
    "oracle_bps": ("k-o", "from the true channel"),
    "best_bps": ("k:", "the most there is"),
    "chosen_bps": ("b--o", "from the predicted one"),
}


def draw_block_error_rates(
    rates: Mapping[str, Mapping[str, pd.DataFrame]], title: str, path: Path
) -> None:
    """Draw BLER above, BER below, a column a modulation, with 95 % intervals.

    Triangles are their ends where no block failed.
    """
    figure, axes = panels(5.6 * len(rates), 8, 2, len(rates), grid=False)
    for column, (modulation, curves) in enumerate(rates.items()):
        for name, (label, colour, line) in STYLES.items():
            if name not in curves:
                continue
            curve, style = curves[name], {"color": colour, "linestyle": line, "marker": "."}
            bler = curve.bler.where(curve.errors > 0).to_numpy()
            counts = zip(curve.errors, curve.blocks, strict=True)
            # Of counts, hence the binomial's own interval: no normal one holds at 0 errors.
            ends = np.array([binomial_interval(int(e), int(n)) for e, n in counts])
            reach = np.maximum([[-1], [1]] * (ends.T - bler), 0)
            # None failed: the limit alone is known, and a curve through it would show a floor.
            limit = ends[:, 1][curve.errors == 0]
            axes[0, column].plot(
                curve.index[curve.errors == 0], limit, "v", color=colour, fillstyle="none"
            )
            axes[0, column].errorbar(
                curve.index, bler, reach, **style, capsize=2, label=label, linewidth=1.2
            )
            axes[1, column].plot(curve.index, curve.ber.where(curve.ber > 0), **style)
        axes[0, column].set_title(f"{modulation.upper()}, one layer, {title}", fontsize=10)
        # 10 % is the target of rate adaptation in 5G NR (TS 38.214, 5.2.2.1).
        axes[0, column].axhline(0.1, color="grey", linewidth=0.6)
        for row, ylabel in enumerate(("block error rate", "bit error rate")):
            axes[row, column].set(yscale="log", xlabel="Eb/N0 [dB]", ylabel=ylabel)
            axes[row, column].grid(alpha=0.3, which="both")
    axes[0, 0].plot([], [], "v", color="grey", fillstyle="none", label="none failed: 95 % limit")
    axes[0, 0].legend(fontsize=7)
    save(figure, path)


def draw_rates(
    rates: list[Rates], confidence: np.ndarray, least: float, title: str, path: Path
) -> None:
    """Draw throughput over noise, and the confidence of right and wrong choices,
    `least` of it accepted.
    """
    figure, ((curves, bars),) = panels(11, 4, 1, 2)
    for name, (style, label) in RATES.items():
        mean = [getattr(rate, name).mean() / 1e6 for rate in rates]
        curves.plot([rate.snr_db for rate in rates], mean, style, label=label)
    curves.set(
        title=title,
        xlabel="median signal-to-noise ratio [dB]",
        ylabel="mean throughput of one layer [Mbit/s]",
    )
    curves.legend()
    middle = rates[len(rates) // 2]
    # Misses of three and more are rare: one box for them.
    miss = np.minimum(np.abs(middle.chosen - middle.oracle), 3)
    groups = {name: confidence[miss == value] for value, name in enumerate(("0", "1", "2", "more"))}
    present = {f"{name}\n(n={len(group)})": group for name, group in groups.items() if len(group)}
    bars.boxplot(list(present.values()), tick_labels=list(present))
    bars.set(xlabel=f"MCS error at {middle.snr_db:.0f} dB", ylabel="confidence")
    if np.isfinite(least):
        bars.axhline(least, color="grey", linestyle="--", label=f"accepted from {least:.2g} on")
        bars.legend()
    share = middle.chosen_bps.mean(), middle.oracle_bps.mean()
    of = "{:.1f} of {:.1f} Mbit/s".format(*(value / 1e6 for value in share))
    bars.set_title(f"at {middle.snr_db:.0f} dB: {of}")
    save(figure, path)


def draw_acceptance(
    acceptance: Mapping[str, tuple[float, pd.DataFrame]], share: float, path: Path
) -> None:
    """Draw the block error rate of the surest share of positions, as of `acceptance`,
    a panel a modulation.
    """
    figure, grid = panels(5.5 * len(acceptance), 4, 1, len(acceptance))
    for axis, (modulation, (ebno_db, rates)) in zip(grid[0], acceptance.items(), strict=True):
        for name in rates:
            label, colour, _ = STYLES[f"{name}@accepted"]
            axis.plot(
                rates.index, rates[name], ".-", color=colour, label=label.removesuffix(", accepted")
            )
        axis.axvline(share, color="grey", linestyle=":", label="accepted")
        axis.set(
            title=f"{modulation.upper()} at {ebno_db:g} dB",
            xlabel="share of positions accepted, surest first",
            ylabel="block error rate",
        )
        axis.legend(fontsize=8)
    save(figure, path)
