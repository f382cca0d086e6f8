"""`model=committee`: several methods that learn apart and answer together, each with the same say.

Methods that err differently err less together: the slow, accurate end of the accuracy-latency front. Each
member alone is one of its faster points (gsparc/tradeoff/members.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.method import FitReport, Method, Prediction
from gsparc.ops import Pose
from gsparc.trainer import Training


class Committee(Method):
    """The mean of its members' answers.

    Args:
        members: unfitted methods by name, in the order in which they learn.
        name: as it appears in tables.
    """

    def __init__(self, members: Mapping[str, Method], name: str = "committee") -> None:
        if not members:
            raise ValueError("committee: model.members is empty; name at least one method")
        self.members, self.name = dict(members), name
        self.site: Site | None = None
        self._training = Training()

    @property
    def effects(self) -> str:
        """The members' effects, for `summary.json`."""
        found = dict.fromkeys(getattr(member, "effects", "none") for member in self.members.values())
        return "+".join(found)

    @property
    def training(self) -> Training:
        """Length and pace of the members that learn step by step."""
        return self._training

    @training.setter
    def training(self, training: Training) -> None:
        self._training = training
        for number, member in enumerate(self.members.values()):
            if hasattr(member, "training"):  # twins would say the same
                member.training = replace(training, seed=training.seed + number)

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Fit every member in its own folder; the bill is the sum."""
        self.site = data.site
        reports = {name: member.fit(data, fold, run_dir / name) for name, member in self.members.items()}
        bill = [f"{name}: {report.seconds:.3g} s" for name, report in reports.items()]
        notes = [note for report in reports.values() for note in report.notes]
        return FitReport(sum(r.seconds for r in reports.values()), (*notes, "; ".join(bill)))

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; confidence is the mean of those that have one."""
        if self.site is None:
            raise ValueError(f"{self.name}: fit or restore it first")
        return mean_of([member.predict(tx, rx) for member in self.members.values()])

    def state(self) -> dict[str, Any]:
        """Every member's."""
        return {name: member.state() for name, member in self.members.items()}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`; `KeyError` when a member is missing."""
        self.site = site
        for name, member in self.members.items():
            member.restore(site, state[name])

    def size(self) -> int:
        """Gaussians, sources or stored samples of all members together."""
        return sum(member.size() for member in self.members.values())


def mean_of(found: list[Prediction]) -> Prediction:
    """One answer from several of equal weight."""
    mean = found[0].mean
    for other in found[1:]:
        mean = mean + other.mean
    sure = [f.confidence for f in found if f.confidence is not None]
    return Prediction(
        mean / len(found) if len(found) > 1 else mean,
        torch.stack(sure).mean(0) if sure else None,
    )
