"""The three experiments of the link and their figures, as flat facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from gsparc.link.adaptation import Adaptation, Rates
from gsparc.link.beams import gain, loss_db
from gsparc.link.pusch import Blocks, Pusch
from gsparc.link.statistics import crossing, interval

STEEP = (0.005, 0.9)  # block error rates of perfect knowledge between which every block counts
FALLBACK = "lmmse"


@dataclass(frozen=True)
class Curve:
    """Block and bit error rates of one receiver over some positions."""

    ebno_db: np.ndarray
    bler: np.ndarray
    ber: np.ndarray
    errors: np.ndarray
    blocks: np.ndarray


def beam_facts(true: Tensor, predicted: Tensor, accepted: np.ndarray) -> dict[str, Any]:
    """`beams/<antennas>/*`: gain of true and predicted beams, and the loss [dB]; 8 and all antennas."""
    facts: dict[str, Any] = {}
    for count in sorted({min(8, true.shape[1]), true.shape[1]}):
        there, guess = true[:, :count], predicted[:, :count]
        loss = loss_db(there, guess).numpy()
        lost = gain(there, guess).mean() / gain(there, there).mean()
        facts |= {
            f"beams/{count}/gain_db": float(10 * gain(there, there).mean().log10()),
            f"beams/{count}/predicted_gain_db": float(10 * gain(there, guess).mean().log10()),
            f"beams/{count}/loss_db": float(-10 * lost.log10()),
            f"beams/{count}/loss_db_mean": float(loss.mean()),
            f"beams/{count}/loss_db_p95": float(np.quantile(loss, 0.95)),
            f"beams/{count}/loss_db_accepted": float(loss[accepted].mean()) if accepted.any() else None,
        }
    return facts


def adapt(
    channels: tuple[Tensor, Tensor],
    aside: tuple[Tensor, Tensor],
    snr_db: list[float],
    settings: Mapping[str, Any],
    tick: Callable[[], None],
) -> list[Rates]:
    """Rates at noise levels that put the median position at `snr_db`.

    Args:
        channels: true and predicted, (n, K) each.
        aside: the same of other positions, on which the backoff is chosen.
        snr_db, settings: see conf/link.yaml.
        tick: called after each level.
    """
    true, predicted = channels
    loop = Adaptation(
        float(settings["bler_target"]), int(settings["subcarriers"]), float(settings["symbols_per_s"])
    )
    median = float(true.abs().square().mean(1).median())
    found = []
    for level in snr_db:
        noise = median / 10 ** (level / 10)
        tried = {b: loop.rates(*aside, noise, b).chosen_bps.mean() for b in settings["backoff_db"]}
        found.append(loop.rates(true, predicted, noise, max(tried, key=lambda b: tried[b])))
        tick()
    return found


def rate_facts(found: list[Rates], accepted: np.ndarray, score: np.ndarray) -> dict[str, Any]:
    """`mcs/<snr>dB/*`: throughput against the oracle, misses, outage; of all and of accepted positions."""
    facts: dict[str, Any] = {}
    for one in found:
        room = f"mcs/{one.snr_db:.0f}dB"
        miss = np.abs(one.chosen - one.oracle)
        # Whoever is not accepted sends pilots, and chooses as the oracle does.
        together = np.where(accepted, one.chosen_bps, one.oracle_bps)
        facts |= {
            f"{room}/oracle_mbps": one.oracle_bps.mean() / 1e6,
            f"{room}/chosen_mbps": one.chosen_bps.mean() / 1e6,
            f"{room}/shortfall": 1 - one.chosen_bps.mean() / one.oracle_bps.mean(),
            f"{room}/shortfall_with_fallback": 1 - together.mean() / one.oracle_bps.mean(),
            f"{room}/exact": float((miss == 0).mean()),
            f"{room}/off_by_more_than_2": float((miss > 2).mean()),
            f"{room}/outage": float(one.outage.mean()),
            f"{room}/backoff_db": one.backoff_db,
        }
        for share in (0.5, 0.7, 0.9):
            surest = score >= np.quantile(score, 1 - share)
            short = 1 - one.chosen_bps[surest].mean() / one.oracle_bps[surest].mean()
            facts[f"{room}/shortfall_surest_{share:.0%}"] = short
        if accepted.any():
            taken = one.chosen_bps[accepted].mean() / one.oracle_bps[accepted].mean()
            facts[f"{room}/shortfall_accepted"] = 1 - taken
            facts[f"{room}/off_by_more_than_2_accepted"] = float((miss[accepted] > 2).mean())
    return facts


def transmit(
    pusch: Pusch,
    true: Tensor,
    predicted: Tensor,
    variance: Tensor,
    levels: list[float],
    sizes: tuple[int, int, int],
    tick: Callable[[str], None],
) -> list[Blocks]:
    """Blocks at every Eb/N0: a few everywhere, all where curves fall; channels (P, K).

    Args:
        sizes: blocks of the coarse look, of a full point, and of a batch.
        tick: told what is being done.
    """
    coarse, fine, batch = sizes
    order = np.arange(max(coarse, fine)) % len(true)
    found = []
    for level in levels:
        tick(f"{level:g} dB")
        some = pusch.run(true, predicted, variance, level, order[:coarse], batch)
        if STEEP[0] < some.failed["perfect"].mean() < STEEP[1] or _floor(some):
            rest = pusch.run(true, predicted, variance, level, order[coarse:fine], batch)
            some = _joined(some, rest)
        found.append(some)
    return found


def _floor(blocks: Blocks) -> bool:
    """Whether only the predicted receivers still fail."""
    return bool(blocks.failed["predicted"].mean() > STEEP[0] and blocks.failed["perfect"].mean() < STEEP[1])


def _joined(first: Blocks, second: Blocks) -> Blocks:
    return Blocks(
        first.ebno_db,
        np.concatenate([first.position, second.position]),
        {name: np.concatenate([first.failed[name], second.failed[name]]) for name in first.failed},
        {
            name: np.concatenate([first.bit_errors[name], second.bit_errors[name]])
            for name in first.bit_errors
        },
    )


def curves(found: list[Blocks], accepted: np.ndarray) -> dict[str, Curve]:
    """Curves by name: each receiver on all and on accepted positions, prediction with fallback on all."""
    taken = [accepted[b.position] for b in found]
    wanted: dict[str, Curve] = {}
    for name in found[0].failed:
        failed, wrong = [b.failed[name] for b in found], [b.bit_errors[name] for b in found]
        wanted[name] = _curve(found, failed, wrong)
        wanted[f"{name}@accepted"] = _curve(
            found,
            [f[t] for f, t in zip(failed, taken, strict=True)],
            [w[t] for w, t in zip(wrong, taken, strict=True)],
        )
    wanted["fallback"] = _curve(
        found,
        [np.where(t, b.failed["predicted"], b.failed[FALLBACK]) for b, t in zip(found, taken, strict=True)],
        [
            np.where(t, b.bit_errors["predicted"], b.bit_errors[FALLBACK])
            for b, t in zip(found, taken, strict=True)
        ],
    )
    return wanted


def _curve(found: list[Blocks], failed: list[np.ndarray], wrong: list[np.ndarray]) -> Curve:
    return Curve(
        np.array([b.ebno_db for b in found]),
        np.array([f.mean() if len(f) else np.nan for f in failed]),
        np.array([w.mean() if len(w) else np.nan for w in wrong]),
        np.array([f.sum() for f in failed]),
        np.array([len(f) for f in failed]),
    )


def pusch_facts(modulation: str, drawn: Mapping[str, Curve]) -> dict[str, Any]:
    """`pusch/<modulation>/<curve>/*`: rates with intervals, Eb/N0 at 10 %, and how far behind perfect."""
    facts: dict[str, Any] = {}
    for name, curve in drawn.items():
        room = f"pusch/{modulation}/{name}"
        at = crossing(curve.ebno_db, curve.bler)
        reference = crossing(*_xy(drawn["perfect@accepted" if name.endswith("@accepted") else "perfect"]))
        facts[f"{room}/ebno_at_bler_0.1"] = at
        facts[f"{room}/behind_perfect_db"] = None if at is None or reference is None else at - reference
        for i, level in enumerate(curve.ebno_db):
            low, high = interval(int(curve.errors[i]), int(curve.blocks[i]))
            facts |= {
                f"{room}/{level:g}dB/bler": None if np.isnan(curve.bler[i]) else float(curve.bler[i]),
                f"{room}/{level:g}dB/bler_low": low,
                f"{room}/{level:g}dB/bler_high": high,
                f"{room}/{level:g}dB/ber": None if np.isnan(curve.ber[i]) else float(curve.ber[i]),
                f"{room}/{level:g}dB/blocks": int(curve.blocks[i]),
            }
    return facts


def _xy(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    return curve.ebno_db, curve.bler


def acceptance(found: list[Blocks], score: np.ndarray, shares: np.ndarray) -> dict[str, np.ndarray]:
    """Block error rates of the surest shares at the Eb/N0 where perfect knowledge fails in about a tenth."""
    rates = np.array([b.failed["perfect"].mean() for b in found])
    at = found[int(np.argmin(np.abs(np.log(np.maximum(rates, 1e-3) / 0.1))))]
    curves = {name: np.full(len(shares), np.nan) for name in at.failed}
    for i, share in enumerate(shares):
        taken = score[at.position] >= np.quantile(score, 1 - share)
        for name in curves:
            curves[name][i] = at.failed[name][taken].mean()
    return {"share": shares, "ebno_db": np.array(at.ebno_db), **curves}
