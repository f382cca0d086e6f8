"""`gsparc evaluate ckpt=FILE dataset.root=DIR eval_on=test`: test a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsparc.apps.maps.against_rows import drive_beside_map, drive_beside_model
from gsparc.apps.maps.promise import read_promise
from gsparc.base.errors import DataError
from gsparc.data.schema import Measurements
from gsparc.data.split_files import write_split
from gsparc.data.splits import Split
from gsparc.datasets.own import read_any
from gsparc.evaluation.by_part import Drive, describe_parts
from gsparc.evaluation.results import Run, frame_of_runs
from gsparc.evaluation.summary import remarks
from gsparc.pictures.confidence_pictures import PICTURES, draw_confidences
from gsparc.pictures.parts import draw_bias_by_part
from gsparc.pictures.plots import draw_sweep
from gsparc.prediction.hearing import read_hearing
from gsparc.runs.evaluate import Evaluation, evaluate
from gsparc.runs.open_runs import open_run
from gsparc.runs.output import CommandCall, Result, command, tables_of


def evaluate_files(
    paths: Sequence[str | Path],
    dataset: Mapping[str, Any] | None = None,
    split: Mapping[str, Any] | None = None,
    *,
    eval_on: str = "test",
    baselines: Sequence[str] | None = (),
) -> tuple[Evaluation, Measurements, Split]:
    """Evaluate checkpoints of one run, one per fold.

    Other data than theirs are tested whole where no split is given, beside baselines that learned
    from the rows that the models learned from.

    Args:
        paths, dataset, split: see `open_run` and `OpenRun.read`.
        eval_on: `train`, `val` or `test`.
        baselines: shown beside it; None: all plain methods that serve the data.

    Raises:
        ValueError: as these.
    """
    run = open_run(paths, dataset or {}).read(split, others_whole=True)
    other, without = run.data.site.sha256 != run.stored[0].site.sha256, None
    # Without the rows that the models learned from, baselines would have learned from others.
    if other and run.trained is None and (baselines is None or len(baselines)):
        baselines, without = (), "the file that the model was trained on is gone, or another"
    seconds = [stored.extra.get("train_s") for stored in run.stored]
    # One fold that does not say its seconds makes the mean of all unknown.
    train_s = None if None in seconds else [float(s) for s in seconds if s is not None]
    hearing = [read_hearing(stored.extra) for stored in run.stored]
    evaluation = evaluate(
        run.methods,
        train_s,
        run.data,
        run.split,
        eval_on=eval_on,
        baselines=baselines,
        learned=run.trained if other else None,
        hearing=hearing,
    )
    # All folds of a run share its configuration, and so its seed.
    seed = run.stored[0].configuration.get("seed")
    evaluation.facts.update(
        {"split/foreign": run.doubt, "split/without_baselines": without, "seed": seed}
    )
    return evaluation, run.data, run.split


@command()
def task(call: CommandCall) -> Result:
    """Test checkpoints, or a map's file."""
    given, run_dir, paths = call.given, call.folder, call.paths
    if paths[0].endswith(".npz"):
        return _judge_map(paths[0], given["dataset"], run_dir)
    evaluation, data, split = evaluate_files(
        paths,
        given["dataset"],
        given["split"],
        eval_on=given["eval_on"],
        baselines=given["baselines"],
    )
    facts = {**evaluation.facts, "ckpt": ", ".join(paths)}
    evaluation.write(run_dir)
    rows, eval_on = frame_of_runs([Run(run_dir, facts)]), given["eval_on"]
    if evaluation.columns:
        draw_sweep(rows, f"{data.site.name}, {eval_on} rows", run_dir / "distributions.png")
        draw_confidences(PICTURES, rows, f"{data.site.name}, {eval_on} rows", run_dir)
    write_split(run_dir / "split.json", split, len(data), data.site.sha256)
    title = f"{data.site.name}, split {split.title}, {eval_on}"
    # Who opened the files has warned of it, and warnings are repeated below the table.
    notes = remarks({**facts, "split/foreign": None}, eval_on)
    tables = tables_of(facts, title, eval_on, evaluation.stations)
    if "error_db" not in evaluation.columns or not len(evaluation.columns["error_db"]):
        return Result(facts, tables, notes)
    promise = read_promise(open_run(paths, given["dataset"]).stored[0].extra)
    drive = drive_beside_model(evaluation.columns, data, promise)
    lines, parts = _judge(drive, f"{data.site.name}, {eval_on} rows", run_dir)
    return Result(facts, tables, [*notes, *lines], columns={"by_part.csv": parts})


def _judge_map(path: str, dataset: Mapping[str, Any], folder: Path) -> Result:
    """A map's file beside the rows of a data set."""
    if dataset.get("file") is None:
        raise DataError(f"ckpt={path}: rows to judge it by are needed: dataset.file=FILE")
    given = {name: value for name, value in dataset.items() if name not in ("file", "name")}
    data = read_any(dataset["file"], **given).data
    drive = drive_beside_map(path, data)
    lines, parts = _judge(drive, f"{Path(path).name} beside {data.site.name}", folder)
    names = ("rows", "squares", "bias_db", "rmse_db", "within")
    facts = {f"drive/{name}": parts[name][0] for name in names if parts}
    return Result({**facts, "ckpt": path}, (), lines, columns={"by_part.csv": parts})


def _judge(drive: Drive, title: str, folder: Path) -> tuple[list[str], dict[str, list[Any]]]:
    """Lines and columns of `by_part.csv`, and the picture."""
    records = drive.judge()
    if records:
        draw_bias_by_part(drive, records, title, folder / "drive.png")
    columns = {name: [row[name] for row in records] for name in next(iter(records), ())}
    return describe_parts(records, drive.share), columns
