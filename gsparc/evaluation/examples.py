"""A few test rows as every method predicts them: kept beside a run's figures,
drawn side by side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.base.files import write_archive
from gsparc.data.schema import Measurements
from gsparc.evaluation.results import distinct_baselines
from gsparc.models.method import Method
from gsparc.prediction.left_out import predict_rows
from gsparc.processes.few_rows import evenly_spaced

FILE = "predictions.npz"
# Rows kept: spread over the tested ones, as rows beside each other were measured beside each other
MOST = 4


@dataclass(frozen=True)
class Examples:
    """Spectra of B test rows, measured and predicted.

    Attributes:
        rows: (B,) of the dataset.
        edges: (4,) least and largest azimuth, least and largest elevation [degrees].
        truth: (B, H, W) in [0, 1].
        confidence: (B,) of the run's own method; NaN where it states none.
        predicted: by name of a method (B, H, W), the run's own last.
    """

    rows: np.ndarray
    edges: np.ndarray
    truth: np.ndarray
    confidence: np.ndarray
    predicted: dict[str, np.ndarray]

    @classmethod
    def of_methods(
        cls, methods: Mapping[str, Method], data: Measurements, rows: np.ndarray
    ) -> Examples:
        """Ask fitted methods, the run's own last, about a few of `rows` (n,)."""
        assert data.site.grid is not None
        few = rows[evenly_spaced(len(rows), MOST)]
        predictions = {name: predict_rows(method, data, few) for name, method in methods.items()}
        confidence = [*predictions.values()][-1].confidence
        sure = np.full(len(few), np.nan) if confidence is None else confidence.numpy()
        means = {name: prediction.mean.numpy() for name, prediction in predictions.items()}
        return cls(few, np.array(data.site.grid.edges()), data.targets(few).numpy(), sure, means)

    def write(self, path: Path) -> None:
        """Write them, atomically; values to three digits, which is what is seen of them."""
        images = {f"of {name}": values for name, values in self.predicted.items()} | {
            "truth": self.truth
        }
        arrays = {name: values.astype(np.float16) for name, values in images.items()}
        arrays |= {"rows": self.rows, "edges": self.edges, "confidence": self.confidence}
        write_archive(path, arrays)

    @classmethod
    def read(cls, path: Path) -> Examples | None:
        """Return what was written; None where there is none."""
        if not path.is_file():
            return None
        with np.load(path) as stored:
            arrays = {name: stored[name].astype(float) for name in stored.files}
        predictions = {
            name[3:]: arrays.pop(name) for name in list(arrays) if name.startswith("of ")
        }
        return cls(arrays.pop("rows").astype(int), predicted=predictions, **arrays)


def join_examples(rows: pd.DataFrame) -> Examples | None:
    """Return what all runs of a frame kept of the rows that the first kept, baselines first;
    None without.
    """
    firsts = rows[~rows.baseline].drop_duplicates("setting")
    examples = [
        (name, Examples.read(run.folder / FILE))
        for name, run in zip(firsts.setting, firsts.run, strict=True)
    ]
    there = [(name, example) for name, example in examples if example is not None]
    same = [
        (name, example) for name, example in there if np.array_equal(example.rows, there[0][1].rows)
    ]
    if not same:
        return None
    beside = set(distinct_baselines(rows).method) - set(firsts.method)
    plain = {
        m: v for _, example in reversed(same) for m, v in example.predicted.items() if m in beside
    }
    runs = {name: [*example.predicted.values()][-1] for name, example in same}
    return replace(same[-1][1], predicted=plain | runs)
