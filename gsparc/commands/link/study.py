"""The three experiments of the link and their figures, as flat facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.commands.link.adaptation import Adaptation, Band, Rates, Rule
from gsparc.commands.link.beams import LEAST, gain, loss_db
from gsparc.commands.link.pusch import Blocks, Pusch
from gsparc.commands.link.statistics import crossing
from gsparc.methods.risk_threshold import binomial_interval

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
    """`beams/<antennas>/*`: gain of true and predicted beams, and the loss [dB]; 8 and all antennas.

    Positions whose channel is silent have no beam: they are counted in `beams/silent` and left out.

    Args:
        true, predicted: (n, A, K).
        accepted: which of the n are.
    """
    few = min(8, true.shape[1])
    loud = true[:, :few].abs().amax((1, 2)) > 0
    facts: dict[str, Any] = {"beams/positions": len(true), "beams/silent": int((~loud).sum())}
    true, predicted, accepted = true[loud], predicted[loud], accepted[loud.numpy()]
    if not len(true):
        return facts
    for count in sorted({few, true.shape[1]}):
        there, guess = true[:, :count], predicted[:, :count]
        loss = loss_db(there, guess).numpy()
        best = gain(there, there).mean()
        own = torch.maximum(gain(there, guess).mean(), LEAST * best)
        facts |= {
            f"beams/{count}/gain_db": float(10 * best.log10()),
            f"beams/{count}/predicted_gain_db": float(10 * own.log10()),
            f"beams/{count}/loss_db": float(10 * (best / own).log10()),
            f"beams/{count}/loss_db_mean": float(loss.mean()),
            f"beams/{count}/loss_db_max": float(loss.max()),
            f"beams/{count}/share_losing_more_than_1_db": float((loss > 1).mean()),
            f"beams/{count}/loss_db_accepted": float(loss[accepted].mean()) if accepted.any() else None,
        }
        for percent in (50, 90, 95, 99):
            facts[f"beams/{count}/loss_db_p{percent}"] = float(np.quantile(loss, percent / 100))
    return facts


def adapt(
    band: Band,
    aside: Band,
    snr_db: list[float],
    settings: Mapping[str, Any],
    tick: Callable[[], None],
) -> dict[Rule, list[Rates]]:
    """Rates of both rules at noise levels that put the median position at `snr_db`.

    Args:
        band: of the positions to be judged.
        aside: of others, on which care and backoff are chosen.
        snr_db, settings: see conf/link.yaml.
        tick: called after each level.

    Raises:
        ValueError: every position is silent.
    """
    loop = Adaptation(
        float(settings["bler_target"]), int(settings["subcarriers"]), float(settings["symbols_per_s"])
    )
    median = band.median_power
    if median <= 0:
        raise ValueError("every test channel of this antenna is silent: there is no rate to adapt")
    noises = [median / 10 ** (level / 10) for level in snr_db]
    # One care for all noise levels: how predictions err does not depend on the noise they are lived in.
    carried = {
        c: sum(loop.rates(aside, n, c, "expected").chosen_bps.mean() for n in noises)
        for c in settings["care"]
    }
    care = max(carried, key=lambda c: carried[c])
    found: dict[Rule, list[Rates]] = {"expected": [], "target": []}
    for noise in noises:
        found["expected"].append(loop.rates(band, noise, care, "expected"))
        backed = {b: loop.rates(aside, noise, b).chosen_bps.mean() for b in settings["backoff_db"]}
        found["target"].append(loop.rates(band, noise, max(backed, key=lambda b: backed[b])))
        tick()
    return found


def rate_facts(found: Mapping[Rule, list[Rates]], accepted: np.ndarray, score: np.ndarray) -> dict[str, Any]:
    """`mcs/<snr>dB/*` of rule `expected`, `mcs/<snr>dB/target/*` of the other: throughput against the oracle.

    `shortfall` is against the oracle that meets the target, `shortfall_best` against the MCS that carries
    most; of all positions, of accepted ones, and of all where the others send pilots.
    """
    facts: dict[str, Any] = {}
    for rule, ones in found.items():
        for one in ones:
            level = f"mcs/{one.snr_db:.0f}dB"
            facts |= _rates_of(one, level if rule == "expected" else f"{level}/{rule}", accepted, score)
    return facts


def _rates_of(one: Rates, room: str, accepted: np.ndarray, score: np.ndarray) -> dict[str, Any]:
    miss = np.abs(one.chosen - one.oracle)
    # Whoever is not accepted sends pilots, and chooses as the oracle does.
    together = np.where(accepted, one.chosen_bps, one.oracle_bps)
    facts: dict[str, Any] = {
        f"{room}/oracle_mbps": one.oracle_bps.mean() / 1e6,
        f"{room}/best_mbps": one.best_bps.mean() / 1e6,
        f"{room}/chosen_mbps": one.chosen_bps.mean() / 1e6,
        f"{room}/shortfall": _shortfall(one.chosen_bps, one.oracle_bps),
        f"{room}/shortfall_best": _shortfall(one.chosen_bps, one.best_bps),
        f"{room}/shortfall_with_fallback": _shortfall(together, one.oracle_bps),
        f"{room}/exact": float((miss == 0).mean()),
        f"{room}/off_by_more_than_2": float((miss > 2).mean()),
        f"{room}/tbler": float(one.fails.mean()),
        f"{room}/outage": float(one.outage.mean()),
        f"{room}/care": one.care,
    }
    for share in (0.5, 0.7, 0.9):
        surest = score >= np.quantile(score, 1 - share)
        short = _shortfall(one.chosen_bps[surest], one.oracle_bps[surest])
        facts[f"{room}/shortfall_surest_{share:.0%}"] = short
    if np.isfinite(one.regret_bps).all():
        facts |= _by_regret(one, room)
    if accepted.any():
        taken = one.chosen_bps[accepted]
        facts |= {
            f"{room}/shortfall_accepted": _shortfall(taken, one.oracle_bps[accepted]),
            f"{room}/shortfall_best_accepted": _shortfall(taken, one.best_bps[accepted]),
            f"{room}/tbler_accepted": float(one.fails[accepted].mean()),
            f"{room}/off_by_more_than_2_accepted": float((miss[accepted] > 2).mean()),
        }
    return facts


def _shortfall(taken: np.ndarray, oracle: np.ndarray) -> float | None:
    """Share of the oracle's throughput that is missed; None where nothing can be carried."""
    return float(1 - taken.mean() / oracle.mean()) if len(oracle) and oracle.mean() > 0 else None


def _by_regret(one: Rates, room: str) -> dict[str, float | None]:
    """`shortfall_calm_<share>`: of the positions whose choice is expected to miss least; `..._fallback`: of
    all positions when the others send pilots. What a rate needs to know is not how large an error is, but
    whether it crosses a step."""
    facts: dict[str, float | None] = {}
    order = np.argsort(one.regret_bps, kind="stable")
    for share in np.arange(0.3, 1.01, 0.1):
        calm = np.zeros(len(order), bool)
        calm[order[: round(share * len(order))]] = True
        together = np.where(calm, one.chosen_bps, one.oracle_bps)
        facts[f"{room}/shortfall_calm_{share:.0%}"] = _shortfall(one.chosen_bps[calm], one.oracle_bps[calm])
        facts[f"{room}/shortfall_calm_{share:.0%}_fallback"] = _shortfall(together, one.oracle_bps)
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
        falling = STEEP[0] < some.failed["perfect"].mean() < STEEP[1]
        if fine > coarse and (falling or _floor(some)):
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
            low, high = binomial_interval(int(curve.errors[i]), int(curve.blocks[i]))
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
    """Block error rates of the surest `shares` by `score` (P,), by receiver, with `share` and `ebno_db`.

    At the Eb/N0 where perfect knowledge fails in about a tenth.
    """
    rates = np.array([b.failed["perfect"].mean() for b in found])
    at = found[int(np.argmin(np.abs(np.log(np.maximum(rates, 1e-3) / 0.1))))]
    curves = {name: np.full(len(shares), np.nan) for name in at.failed}
    for i, share in enumerate(shares):
        taken = score[at.position] >= np.quantile(score, 1 - share)
        for name in curves:
            curves[name][i] = at.failed[name][taken].mean()
    return {"share": shares, "ebno_db": np.array(at.ebno_db), **curves}


def tradeoff(found: list[Blocks], score: np.ndarray, shares: np.ndarray) -> dict[str, Any]:
    """`<share>/behind_db`: dB behind perfect knowledge at 10 % failed blocks, on the surest shares."""
    facts: dict[str, Any] = {}
    levels = np.array([b.ebno_db for b in found])
    for share in shares:
        taken = [score[b.position] >= np.quantile(score, 1 - share) for b in found]

        def at(name: str, taken: list[np.ndarray] = taken) -> float | None:
            rates = [b.failed[name][t].mean() for b, t in zip(found, taken, strict=True)]
            return crossing(levels, np.array(rates))

        own, perfect = at("predicted"), at("perfect")
        facts[f"{share:.0%}/behind_db"] = None if own is None or perfect is None else own - perfect
    return facts
