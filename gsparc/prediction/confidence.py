"""How sure predictions are, and from when on a model is trusted."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.base.limits import SHARE, Checked, setting
from gsparc.models import checkpoint
from gsparc.models.method import Prediction
from gsparc.models.predicting import predict_with_threads
from gsparc.physics.decibels import from_decibels
from gsparc.prediction.query import Asked, PlacedQuery
from gsparc.processes.stored import Stored, to_plain
from gsparc.processes.uncertainty import Threshold

log = logging.getLogger(__name__)

KINDS = ("expected", "learned")  # the first that a method states orders its errors best
MARGIN = 0.1  # of the longest side, around the places that a threshold is for


def calibrated_box(*places: np.ndarray) -> np.ndarray:
    """Return the corners (2, 3) [m] around places (n, 3) each,
    grown by a tenth of the longest side.

    >>> calibrated_box(np.zeros((1, 3)), np.array([[10.0, 5.0, 0.0]]))
    array([[-1., -1., -1.],
           [11.,  6.,  1.]])
    """
    joined = np.concatenate(places)
    margin = MARGIN * np.ptp(joined, axis=0).max()
    return np.stack([joined.min(axis=0) - margin, joined.max(axis=0) + margin])


KEY = "confidence"
GONE = "known", "kernel"  # that older checkpoints hold


@dataclass(frozen=True)
class Guarantee(Stored, Checked):
    """What is promised.

    >>> Guarantee(limit_db=-10.0).is_bad(np.array([0.05, 0.5]))
    array([False,  True])

    Attributes:
        limit_db: a prediction is bad when |e|^2 / |h|^2 exceeds this [dB].
        alpha: largest share of bad ones among the accepted.
        delta: probability that a calibration set misleads.
    """

    limit_db: float = -10.0
    alpha: float = setting(0.1, SHARE)
    delta: float = setting(0.1, SHARE)

    def is_bad(self, relative_error: np.ndarray) -> np.ndarray:
        """Tell whether predictions (n,) are bad."""
        return relative_error > from_decibels(self.limit_db)


@dataclass(frozen=True)
class Trusted(Stored):
    """The confidence that positions are ordered by, and a threshold that promises something.

    Attributes:
        kind: one of `KINDS`; None: whatever the method says itself.
        threshold: accept confidences of at least this; infinite where nothing can be promised.
        promise: what the threshold promises; None where none was asked for.
        box: `calibrated_box` of local places that the threshold is for; None (older files): not
            known.
        failed: share of trials whose threshold accepted some, and failed, where that is surely more
            than was promised of all trials; else None.
    """

    kind: str | None = None
    threshold: float = float("inf")
    promise: Guarantee | None = None
    box: np.ndarray | None = field(default=None, repr=False)
    failed: float | None = field(default=None, repr=False)

    def covers(self, places: np.ndarray) -> np.ndarray:
        """Tell whether local places (B, 3) [m] lie in the box, (B,) bool;
        all where none is known.
        """
        if self.box is None:
            return np.ones(len(places), bool)
        return np.all((places >= self.box[0]) & (places <= self.box[1]), axis=1)

    def confidence(self, prediction: Prediction, kind: str | None = None) -> np.ndarray:
        """Return confidences (B,) float32 in [0, 1].

        Raises:
            ValueError: the method does not have what `kind` needs.
        """
        # What is asked for, then what was calibrated, then the method's own.
        kind = kind or self.kind or "learned"
        check_kind(kind)
        if (score := score_prediction(kind, prediction)) is None:
            own = "has no confidence of its own"
            fault = own if kind == "learned" else "states no error variance"
            raise ValueError(f"confidence={kind}: this model {fault}")
        return as_confidence(kind, score).astype(np.float32)


def score_prediction(kind: str, prediction: Prediction) -> np.ndarray | None:
    """Return the scores (B,) of a kind, larger is surer; None where the method states none.

    `learned` is the method's own confidence, `expected` minus its error variance over the power it
    predicts (in a fade the same variance is a larger relative error).
    """
    scores = prediction.confidence
    if kind == "expected" and (scores := prediction.variance) is not None:
        # A predicted silence counts as -300 dB, as a power
        # of 0 would make every score of it infinite.
        scores = -scores / prediction.mean.abs().square().flatten(1).mean(1).clamp_min(1e-30)
    return None if scores is None else scores.double().numpy()


def check_kind(kind: str) -> None:
    """Refuse a kind that there is not: `ValueError`."""
    if kind not in KINDS:
        raise ValueError(f"confidence={kind}: expected one of {', '.join(KINDS)}")


def as_confidence(kind: str, score: np.ndarray) -> np.ndarray:
    """Return scores (n,) of `Evidence` as confidences (n,) in [0, 1] in the same order.

    >>> as_confidence("expected", np.array([0.0, -1.0, -9.0]))  # minus the relative error
    array([1. , 0.5, 0.1])
    """
    if kind == "learned":
        return score
    # An expected error of 1 is a confidence of a half.
    return 1 / (1 - np.minimum(score, 0))


def store_trusted(path: str | Path, trusted: Trusted) -> None:
    """Store in a checkpoint, replacing what was there;
    the file is rewritten whole or not at all.
    """
    checkpoint.update_extra(path, {KEY: to_plain(trusted)})


def read_trusted(extra: Mapping[str, Any]) -> Trusted:
    """Return what a checkpoint's `extra` holds;
    the method's own confidence where it was never calibrated.
    """
    if KEY not in extra:
        return Trusted()
    state = {name: part for name, part in extra[KEY]["state"].items() if name not in GONE}
    if state.get("kind") not in (None, *KINDS):
        text = (
            "confidence=%s and its threshold are of an older program and left out: "
            "gsparc calibrate ckpt=FILE confidence=expected, or learned, stores another"
        )
        log.warning(text, state["kind"])
        return Trusted()
    return Trusted.read(state)


def confidence_threshold(kind: str, threshold: Threshold) -> float:
    """Return a threshold of scores as one of confidences."""
    # -infinite accepts all, and confidences begin at 0.
    value = np.array(threshold.value)
    return max(float(as_confidence(kind, value)), 0.0) if value < np.inf else float("inf")


class ConfidenceMixin(Asked):
    """What a `Predictor` says of how good its answers are."""

    trusted: Trusted
    kind: str | None
    _told_of_failures = False

    def confidence(self, tx: Any = None, rx: Any = None, *, uplink: Any = None) -> Any:
        """Return how sure the model is, (B,) float32 in [0, 1], larger is surer; (B, T) of several
        stations.

        Of the kind that `gsparc.load(confidence=...)` was asked for, else the one that
        `gsparc calibrate` stored, else the model's own.

        >>> near, far = predictor.confidence(rx=[[2.0, 1.0, 1.5], [900.0, 1.0, 1.5]])
        >>> bool(near > far)  # 900 m away from everything measured
        True

        Raises:
            ValueError: the method has no confidence of that kind.
        """
        placed, sure = self._query_confidence(tx, rx, uplink)
        return placed.match(placed.by_station(sure))

    def accepts(self, tx: Any = None, rx: Any = None, *, uplink: Any = None) -> Any:
        """Tell whether predictions (B,) bool are among those of which
        at most `alpha` are promised to be bad.

        False beyond the places learned from and calibrated on (their box, grown by a tenth of its
        longest side), and where no threshold keeps the promise (`Predictor.trusted.threshold` is
        infinite). Where the promise failed in trials this is logged once.

        >>> predictor.accepts(rx=[2.0, 1.0, 1.5])  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        ValueError: accepts: no threshold is stored; gsparc calibrate ckpt=FILE seeks one, ...

        Raises:
            ValueError: the model was never calibrated, or for another kind of confidence.
        """
        if self.trusted.promise is None:
            raise ValueError(
                "accepts: no threshold is stored; gsparc calibrate ckpt=FILE seeks one, or says "
                "why not"
            )
        if self.kind not in (None, self.trusted.kind):
            raise ValueError(
                f"accepts: the threshold is one of confidence={self.trusted.kind}, not {self.kind}"
            )
        if self.trusted.failed is not None and not self._told_of_failures:
            self._told_of_failures = True
            shares = 100 * self.trusted.failed, 100 * self.trusted.promise.delta
            text = (
                "accepts: of thresholds that accepted any, %.0f %% failed in trials; at most "
                "%.0f %% of all were promised to"
            )
            log.warning(text, *shares)
        placed, sure = self._query_confidence(tx, rx, uplink)
        good = sure >= self.trusted.threshold
        if uplink is None:  # an uplink has no place
            places = placed.query.places(self.site).numpy()
            good &= torch.from_numpy(self.trusted.covers(places))
        good = placed.match(placed.by_station(good))
        return bool(good) if isinstance(good, float) else good

    def _query_confidence(self, tx: Any, rx: Any, uplink: Any) -> tuple[PlacedQuery, Tensor]:
        """What was asked, and confidences of all its rows."""
        if uplink is not None:
            from gsparc.prediction import channels

            query = channels.uplink_query(self.method, self.site, uplink)
            placed = PlacedQuery(query, np.ndim(uplink) == 2, isinstance(uplink, Tensor))
            sure = self._method_confidence(self.method.predict(query))
        else:
            placed = self.queries.query(tx, rx)
            prediction = predict_with_threads(self._whole, placed.query)
            sure = self._method_confidence(prediction)
        if sure is None:
            raise ValueError(f"{self.method.name} has no confidence")
        return placed, sure

    def _method_confidence(self, prediction: Prediction) -> Tensor | None:
        """Of the method's own predictions (B,), of the kind that is wanted;
        None where it has none.
        """
        if prediction.confidence is None and (self.kind or self.trusted.kind) in (None, "learned"):
            return None
        return torch.from_numpy(self.trusted.confidence(prediction, self.kind))
