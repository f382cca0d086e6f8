"""Rows that a model never saw, and what its confidence is worth on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsparc.evaluation.scores import rows_to_score
from gsparc.prediction import risk
from gsparc.prediction.confidence import (
    Guarantee,
    Trusted,
    calibrated_box,
    confidence_threshold,
    read_trusted,
    store_trusted,
)
from gsparc.prediction.left_out import Evidence, gather_evidence
from gsparc.runs.open_runs import open_run


@dataclass(frozen=True)
class Unseen:
    """A checkpoint with evidence of its own test rows:
    a bound holds for rows that nothing was chosen on.

    Attributes:
        path: of the file.
        facts: see `Opened.facts`.
        earlier: what the file holds of its confidence.
        known: (n, D) local places that the model learned from [m].
        evidence: of the test rows.
    """

    path: str
    facts: dict[str, Any]
    earlier: Trusted
    known: np.ndarray
    evidence: Evidence

    @staticmethod
    def open(path: str, dataset: Mapping[str, Any], split: Mapping[str, Any]) -> Unseen:
        """Ask a checkpoint about its test rows; see `open_run`.

        Raises:
            ValueError: it may have learned from some of them, so that no promise would hold.
        """
        run = open_run(path, dataset).read(split, others_whole=True)
        if run.learned != 0:
            advice = "calibrate with the data and split of its training"
            raise ValueError(f"{path} was trained on {run.foreign}; {advice}")
        learned_data, before = run.trained or (run.data, run.split)
        known = learned_data.moving[before.folds[0].learned()]
        rows = rows_to_score(run.split.folds[0], "test")
        evidence = gather_evidence(run.methods[0], run.data, rows)
        return Unseen(path, run.facts(), read_trusted(run.stored[0].extra), known, evidence)

    def calibrate_and_store(
        self, guarantee: Guarantee, kind: str, spatial: bool, seed: int, failed: float | None = None
    ) -> tuple[Trusted, str]:
        """Choose a confidence and its threshold, keep them with the model,
        return them and how it went; `failed` as in `Trusted`.
        """
        evidence, how = self.evidence, (kind, spatial, seed)
        kind_used, choice, *_ = risk.calibrate_threshold(evidence, guarantee, *how, tested=False)
        threshold = confidence_threshold(kind_used, choice)
        box = calibrated_box(self.known, evidence.position)
        stored = Trusted(kind_used, threshold, guarantee, box, failed)
        before = self.earlier.kind or "the model's own"
        # Programs that read confidences get another number from now on: it is said.
        kind_changed = f"confidence={kind_used}, before: {before}; "
        if kind == "auto" and not np.isfinite(threshold):
            # Without a promise the model's own is as good, and programs know it.
            stored, kind_changed = (
                self.earlier,
                (f"confidence stays {before}, the checkpoint is unchanged; "),
            )
        else:
            store_trusted(self.path, stored)
        if np.isfinite(threshold):
            share = np.mean(evidence.scores[kind_used] >= choice.value)
            of = (
                f"at most {guarantee.alpha:.0%} of the accepted are worse than "
                f"{guarantee.limit_db:g} dB"
            )
            from_there = (
                f"accepted from {threshold:.4g}, {share:.0%} of {len(evidence)} test positions"
            )
            of += (
                f", which fails in at most {guarantee.delta:.0%} of cases; threshold stored in "
                f"{self.path}"
            )
            return stored, f"{kind_changed}{from_there}: {of}"
        return (
            stored,
            f"{kind_changed}no threshold keeps the promise: "
            + risk.explain_missing_threshold(evidence, guarantee, *how),
        )
