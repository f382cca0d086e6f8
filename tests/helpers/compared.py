"""Cells of a comparison, and their averages, without a training."""

from pathlib import Path

from gsparc.evaluation.results import Run, as_frame
from gsparc.runs.experiment.table import average_cells, remarks, split_by_problem


def filled(method, value, seed=None, effort=None, split="random", kind="spectrum", **more):
    """The row of a cell with the figure that decides, and other facts."""
    figures = {"spectrum": ("psnr_db", "ssim"), "rssi": ("rmse_db", "mae_db")}[kind]
    facts = {f"test/{name}": number for name, number in zip(figures, (value, 0.9), strict=True)}
    facts |= {
        "split/sha256": f"{split}{seed if more.get('drawn') else ''}",
        "dataset/kind": kind,
        "time/train_s": 1.0,
        "time/train_cpu_s": 1.0,
        "machine/load": 0.1,
    }
    cell = {"dataset": "rfid", "split": split, "method": method, "effort": effort, "seed": seed}
    cell |= {"draws": more.pop("drawn", False), "earlier": more.pop("earlier", "")}
    cell |= {"given": more.pop("given", "")}
    return Run(more.pop("folder", Path("absent")), facts | more).rows()[0] | cell


def drawn(method, *values, **more):
    """A cell for each draw of the split."""
    return [filled(method, value, draw, drawn=True, **more) for draw, value in enumerate(values)]


def said_of(cells, ours="gsparc"):
    """Remarks on the first table of cells."""
    return " | ".join(remarks(split_by_problem(averages(cells))[0], ours))


def averages(cells, timed=None):
    return average_cells(as_frame(cells), timed)
