"""The commands of `gsparc`, where each lives, and what it answers in one line."""

from __future__ import annotations

import difflib
from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        module: has `main()`, which reads `sys.argv`.
        answers: one line for the list.
    """

    module: str
    answers: str


COMMANDS = {
    "train": Command("gsparc.studies.train", "train a method on a dataset and test it beside baselines"),
    "evaluate": Command("gsparc.studies.evaluate", "test a checkpoint again: ckpt=FILE"),
    "check": Command("gsparc.studies.check", "what is in a file of measurements, or what is wrong with it"),
    "simulate": Command(
        "gsparc.studies.simulate", "ray-trace a dataset with the effects it calls for: out=FILE"
    ),
    "study": Command(
        "gsparc.studies.study.command", "variants of one model: kind=effects, positions or measurements"
    ),
    "tradeoff": Command(
        "gsparc.studies.tradeoff.command", "accuracy against milliseconds of one model: ckpt=FILE"
    ),
    "compare": Command(
        "gsparc.studies.compare.command", "every method under the same data, metrics and clock"
    ),
    "calibrate": Command(
        "gsparc.studies.calibrate.command",
        "which confidence to trust, and a threshold with a promise: ckpt=FILE",
    ),
    "link": Command(
        "gsparc.studies.link.command", "rates and block errors with predicted channels: ckpt=FILE"
    ),
    "report": Command("gsparc.studies.report", "one page about many runs: RUN..."),
    "bench": Command(
        "gsparc.studies.bench.command", "timings of the kernels as ratios to the machine's limit"
    ),
}


def listed() -> str:
    """All commands with one line each."""
    width = max(map(len, COMMANDS))
    rows = "".join(f"  {name:<{width}}  {command.answers}\n" for name, command in COMMANDS.items())
    return f"gsparc COMMAND key=value ...\n\n{rows}\n`gsparc COMMAND --help` lists a command's settings.\n"


def nearest(name: str) -> str:
    """`; did you mean 'train'?`, or what there is."""
    close = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(COMMANDS)}"
