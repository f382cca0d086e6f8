"""Which confidence to trust, kept with a model: `gsparc.load` answers with it, and with the threshold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.models import checkpoint
from gsparc.models.method import Prediction
from gsparc.prediction.confidence_scores import KINDS, expected_score, process_variance
from gsparc.prediction.risk_threshold import Promise, Threshold
from gsparc.processes.kernel import Kernel

KEY = "confidence"


@dataclass(frozen=True)
class Trusted:
    """The confidence that was best on positions set aside, and a threshold that promises something.

    Attributes:
        kind: one of `KINDS`; None: whatever the method says itself.
        threshold: accept confidences of at least this; infinite where nothing can be promised.
        promise: what the threshold promises; None where none was asked for.
        known: (n, 3) local positions of the moving end that the method learned from [m].
        kernel: of the process whose variance is a rival; None where no rival was stored.
    """

    kind: str | None = None
    threshold: float = float("inf")
    promise: Promise | None = None
    known: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    kernel: Kernel | None = None

    def confidence(self, said: Prediction, places: np.ndarray | None, kind: str | None = None) -> np.ndarray:
        """Confidence (B,) float32 in [0, 1] of predictions at local `places` (B, 3) [m] (None: unknown).

        Raises:
            ValueError: the method, or the checkpoint, does not have what `kind` needs.
        """
        kind = kind or self.kind or "learned"
        return as_confidence(kind, self._score(kind, said, places)).astype(np.float32)

    def check(self, kind: str) -> None:
        """Refuse a kind that there is not, or that needs what was never stored: `ValueError`."""
        if kind not in KINDS:
            raise ValueError(f"confidence={kind}: expected one of {', '.join(KINDS)}")
        if kind in ("distance", "gp_variance") and self.kernel is None:
            raise ValueError(
                f"confidence={kind}: the checkpoint does not say where was measured; "
                "gsparc calibrate ckpt=FILE stores it"
            )

    def _score(self, kind: str, said: Prediction, places: np.ndarray | None) -> np.ndarray:
        if kind == "learned":
            if said.confidence is None:
                raise ValueError("confidence=learned: this model has no confidence of its own")
            return said.confidence.double().numpy()
        if kind == "expected":
            if said.variance is None:
                raise ValueError("confidence=expected: this model states no error variance")
            return expected_score(said).double().numpy()
        self.check(kind)
        assert self.kernel is not None
        if places is None:
            raise ValueError(f"confidence={kind}: needs a position, and an uplink has none")
        if kind == "distance":
            return -cKDTree(self.known).query(places)[0]
        return -process_variance(self.kernel, self.known, places)


def as_confidence(kind: str, score: np.ndarray) -> np.ndarray:
    """Scores (n,) of `Evidence` as confidences (n,) in [0, 1] in the same order."""
    if kind == "learned":
        return score
    # An expected error, a variance in the prior's, or a distance in metres, of 1 is a confidence of a half.
    return 1 / (1 - np.minimum(score, 0))


def keep(path: str | Path, trusted: Trusted) -> None:
    """Store in a checkpoint, replacing what was there; the file is rewritten whole or not at all."""
    checkpoint.amend(path, {KEY: asdict(trusted)})


def kept(extra: Mapping[str, Any]) -> Trusted:
    """What a checkpoint's `extra` holds; the method's own confidence where it was never calibrated."""
    found = extra.get(KEY)
    if found is None:
        return Trusted()
    promise = None if found["promise"] is None else Promise(**found["promise"])
    kernel = None if found["kernel"] is None else Kernel(**found["kernel"])
    known = np.asarray(found["known"], np.float64)
    return Trusted(found["kind"], float(found["threshold"]), promise, known, kernel)


def threshold_of(kind: str, found: Threshold) -> float:
    """A threshold of scores as one of confidences."""
    value = np.array(found.value)
    return float(as_confidence(kind, value)) if np.isfinite(value) else float("inf")
