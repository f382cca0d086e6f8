"""The three experiments of the link and their figures, as flat facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gsparc.apps.link.adaptation import Adaptation, Band, Rates
from gsparc.apps.link.pusch import Pusch
from gsparc.base.executor import run_all
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.processes.uncertainty import binomial_interval

STEEP = (0.005, 0.9)  # block error rates of perfect knowledge between which every block counts
FALLBACK = "lmmse", "ls"  # the first that is sent
# Of the gain of the true channel's beam: no beam at all is 100 dB off, not infinitely
LEAST = 1e-10


def find_crossing(rate: pd.Series, target: float = 0.1) -> float | None:
    """Return where a curve over its index first falls below `target`, linear in its logarithm,
    or None.
    """
    # No error in all blocks sent: its logarithm is cut at 1e-6.
    x, below = rate.index.to_numpy(), np.log(target / np.maximum(rate.to_numpy(), 1e-6))
    falls = np.flatnonzero((below[:-1] < 0) & (below[1:] >= 0))
    if not len(falls):
        return None
    # Curves fall exponentially: linear in log(rate) between two points.
    ends = slice(falls[0], falls[0] + 2)
    return float(np.interp(0, below[ends], x[ends]))


def beam_gain(true: Tensor, predicted: Tensor) -> Tensor:
    """Return the power gain over one average antenna, beams from `predicted` (n, A, K):
    mean over tones (n,), linear.
    """
    # Maximum ratio transmission: the conjugate prediction, normalised per tone.
    weight = predicted / torch.linalg.vector_norm(predicted, dim=1, keepdim=True).clamp_min(1e-30)
    received = (true * weight.conj()).sum(1).abs().square()
    single = true.abs().square().mean(1)
    return received.mean(1) / single.mean(1).clamp_min(1e-30)


def beam_loss_db(true: Tensor, predicted: Tensor) -> Tensor:
    """Return what is lost against beams from the true channel (n,) [dB], at most 100;
    NaN of silence.
    """
    best = beam_gain(true, true)
    # Largest of both: a beam into a null would be infinitely bad.
    return to_decibels(best / torch.maximum(beam_gain(true, predicted), LEAST * best))


def beam_facts(true: Tensor, predicted: Tensor, accepted: np.ndarray) -> dict[str, Any]:
    """Return `beams/<antennas>/*`: gain of true and predicted beams, and the loss [dB];
    8 and all antennas.

    Positions whose channel is silent have no beam: they are counted in `beams/silent` and left out.

    Args:
        true, predicted: (n, A, K).
        accepted: which of the n are.
    """
    few = min(8, true.shape[1])
    # Of the first antennas: a channel silent on these has no 8-antenna beam.
    loud = true[:, :few].abs().amax((1, 2)) > 0
    facts: dict[str, Any] = {"beams/positions": len(true), "beams/silent": int((~loud).sum())}
    true, predicted, accepted = true[loud], predicted[loud], accepted[loud.numpy()]
    if not len(true):
        return facts
    for count in sorted({few, true.shape[1]}):
        there, guess = true[:, :count], predicted[:, :count]
        loss = beam_loss_db(there, guess).numpy()
        best = beam_gain(there, there).mean()
        gain = torch.maximum(beam_gain(there, guess).mean(), LEAST * best)
        figures = {
            "gain_db": float(to_decibels(best)),
            "predicted_gain_db": float(to_decibels(gain)),
            "loss_db": float(to_decibels(best / gain)),
            "loss_db_mean": float(loss.mean()),
            "loss_db_max": float(loss.max()),
            "share_losing_more_than_1_db": float((loss > 1).mean()),
            "loss_db_accepted": float(loss[accepted].mean()) if accepted.any() else None,
            **{
                f"loss_db_p{share}": float(np.quantile(loss, share / 100))
                for share in (50, 90, 95, 99)
            },
        }
        facts |= {f"beams/{count}/{name}": value for name, value in figures.items()}
    return facts


def adapt_rates(band: Band, aside: Band, settings: Mapping[str, Any], rule: str) -> list[Rates]:
    """Return rates at noise levels that put the median position at `snr_db` of the settings.

    Args:
        band: of the positions to be judged.
        aside: of others, on which the care is chosen.
        settings: `mcs` of conf/link.yaml.
        rule: one of `RULES`.

    Raises:
        ValueError: every position is silent.
    """
    loop = Adaptation(*(settings[name] for name in ("bler_target", "subcarriers", "symbols_per_s")))
    # Noise by the median of positions with power, so that outages do not lower it.
    median = band.median_power
    if median <= 0:
        raise ValueError("every test channel of this antenna is silent: there is no rate to adapt")
    noises = [median / from_decibels(level) for level in settings["snr_db"]]
    # One care for all noise levels: how predictions err does not depend
    # on the noise they are lived in.
    cares = settings["care"] if rule == "carries_most" else []
    delivered = {c: sum(loop.rates(aside, n, c).chosen_bps.mean() for n in noises) for c in cares}
    care = max(delivered, key=lambda c: delivered[c], default=None)
    return run_all(lambda noise: loop.rates(band, noise, care), noises, "noise levels")


def rate_facts(rates: Sequence[Rates], accepted: np.ndarray) -> dict[str, Any]:
    """Return `mcs/<snr>dB/*`: throughput against the oracle.

    `shortfall` is against the oracle that meets the target, `shortfall_best` against the MCS that
    carries most; of all positions, of accepted ones, and of all where the others send pilots.
    """
    parts = ((rate.snr_db, _rates_of(rate, accepted)) for rate in rates)
    return {
        f"mcs/{snr:g}dB/{name}": value for snr, figures in parts for name, value in figures.items()
    }


def _rates_of(one: Rates, accepted: np.ndarray) -> dict[str, Any]:
    chosen, oracle = one.chosen_bps, one.oracle_bps
    facts: dict[str, Any] = {
        "oracle_mbps": oracle.mean() / 1e6,
        "best_mbps": one.best_bps.mean() / 1e6,
        "chosen_mbps": chosen.mean() / 1e6,
        "outage": float(one.outage.mean()),
        "care": one.care,
        # Whoever is not accepted sends pilots, and chooses as the oracle does.
        "shortfall_with_fallback": _shortfall(np.where(accepted, chosen, oracle), oracle),
    }
    for name, some in (("", np.ones(len(accepted), bool)), ("_accepted", accepted)):
        miss = np.abs(one.chosen - one.oracle)[some]
        figures = (
            {
                "shortfall": _shortfall(chosen[some], oracle[some]),
                "shortfall_best": _shortfall(chosen[some], one.best_bps[some]),
                "tbler": float(one.fails[some].mean()),
                "off_by_more_than_2": float((miss > 2).mean()),
            }
            if some.any()
            else {}
        )
        facts |= {key + name: value for key, value in figures.items()}
    return facts


def _shortfall(chosen: np.ndarray, oracle: np.ndarray) -> float | None:
    """Share of the oracle's throughput that is missed; None where nothing can be carried."""
    return float(1 - chosen.mean() / oracle.mean()) if len(oracle) and oracle.mean() > 0 else None


def send_blocks(
    pusch: Pusch, band: Band, levels: list[float], sizes: tuple[int, int, int]
) -> pd.DataFrame:
    """Send blocks at every Eb/N0, as of `Pusch.run`: a few everywhere, all where curves fall.

    Args:
        band: of the positions that blocks are sent over, by turns.
        sizes: blocks of the coarse look, of a full point, and of a batch.
    """
    coarse, fine, batch = sizes
    order = np.arange(max(coarse, fine)) % len(band.true)

    def send_at(level: float) -> list[pd.DataFrame]:
        few = pusch.run(band, level, order[:coarse], batch)
        rate = few.groupby("receiver").failed.mean()
        # An error floor of predictions is looked at too,
        # as long as perfect knowledge fails somewhere.
        worst = max(rate["perfect"], rate["predicted"])  # which may have an error floor
        steep = fine > coarse and STEEP[0] < worst and rate["perfect"] < STEEP[1]
        return [few, pusch.run(band, level, order[coarse:fine], batch)] if steep else [few]

    return pd.concat(chain(*run_all(send_at, levels, "Eb/N0")), ignore_index=True)


def error_curves(blocks: pd.DataFrame, accepted: np.ndarray) -> dict[str, pd.DataFrame]:
    """Return each receiver's curve on all and on accepted positions,
    and prediction with fallback on all.

    A curve's index is the Eb/N0 [dB], its columns `bler`, `ber` (NaN without a block), `errors`,
    `blocks`.
    """
    parts: dict[str, pd.DataFrame] = {}
    for name, rows in blocks.groupby("receiver", sort=False):
        parts[str(name)], parts[f"{name}@accepted"] = rows, rows[accepted[rows.position]]
    if pilot := next((name for name in FALLBACK if name in parts), None):
        others = parts[pilot][~accepted[parts[pilot].position]]
        parts["fallback"] = pd.concat([parts["predicted@accepted"], others])
    levels, counts = blocks.ebno_db.unique(), {"errors": 0, "blocks": 0}
    means = {
        name: part.groupby("ebno_db").agg(
            bler=("failed", "mean"),
            ber=("wrong", "mean"),
            errors=("failed", "sum"),
            blocks=("failed", "size"),
        )
        for name, part in parts.items()
    }
    return {name: mean.reindex(levels).fillna(counts) for name, mean in means.items()}


def pusch_facts(modulation: str, rates: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Return `pusch/<modulation>/<curve>/*`: rates with intervals, Eb/N0 at 10 %,
    and how far behind perfect.
    """
    facts: dict[str, Any] = {}
    crossings = {name: find_crossing(curve.bler) for name, curve in rates.items()}
    for name, curve in rates.items():
        stem, at = f"pusch/{modulation}/{name}", crossings[name]
        reference = crossings["perfect@accepted" if name.endswith("@accepted") else "perfect"]
        facts[f"{stem}/ebno_at_bler_0.1"] = at
        facts[f"{stem}/behind_perfect_db"] = (
            None if at is None or reference is None else at - reference
        )
        for level, row in curve.iterrows():
            low, high = binomial_interval(int(row.errors), int(row.blocks))
            point = {
                key: None if np.isnan(row[key]) else float(row[key]) for key in ("bler", "ber")
            }
            point |= {"bler_low": low, "bler_high": high, "blocks": int(row.blocks)}
            facts |= {f"{stem}/{level:g}dB/{key}": value for key, value in point.items()}
    return facts


def errors_by_acceptance(
    blocks: pd.DataFrame, score: np.ndarray, shares: Sequence[float]
) -> tuple[float, pd.DataFrame]:
    """Return the Eb/N0 [dB] where perfect knowledge fails in about a tenth,
    and block error rates there.

    Of the surest `shares` of positions by `score` (P,), the index; receivers are the columns.
    """
    perfect = blocks[blocks.receiver == "perfect"].groupby("ebno_db", sort=False).failed.mean()
    level = float(np.log(perfect.clip(1e-3) / 0.1).abs().idxmin())
    there = blocks[blocks.ebno_db == level]
    sure, least = score[there.position], {share: np.quantile(score, 1 - share) for share in shares}
    rates = {
        share: there[sure >= least[share]].groupby("receiver").failed.mean() for share in shares
    }
    return level, pd.DataFrame(rates).T
