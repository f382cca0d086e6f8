"""The commands of `gsparc`, where each lives, and what it answers in one line."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        name: also of its configuration, `conf/<name>.yaml`.
        module: has `task(config)`.
        answers: one line for the list.
        bare: setting that takes words without an equals sign, as a list of paths.
        configured: False for a command without a configuration: its module has `main(arguments)`.
    """

    name: str
    module: str
    answers: str
    bare: str | None = None
    configured: bool = True

    def arguments(self, given: Sequence[str]) -> list[str]:
        """A command line in Hydra's words: bare paths become `<bare>=[...]`."""
        paths = [word for word in given if self.bare and "=" not in word and not word.startswith("-")]
        quoted = ",".join("'" + path.replace("'", "\\'") + "'" for path in paths)
        return [
            *(word for word in given if word not in paths),
            *([f"{self.bare}=[{quoted}]"] if paths else []),
        ]

    def run(self) -> None:
        """Run it with the command line in `sys.argv`; ends the process when it fails."""
        module = import_module(self.module)
        if not self.configured:
            sys.exit(module.main(sys.argv[1:]))
        from gsparc.commands import cli

        cli.run(module.task, self.name)


ROOM = "gsparc.commands."
COMMANDS = {
    command.name: command
    for command in (
        Command("train", f"{ROOM}train", "train a method on a dataset and test it beside baselines"),
        Command("evaluate", f"{ROOM}evaluate", "test a checkpoint again: ckpt=FILE"),
        Command(
            "check",
            f"{ROOM}check",
            "what is in files of measurements, or what is wrong: FILE...",
            configured=False,
        ),
        Command(
            "predict", f"{ROOM}predict.command", "predictions at places of a table: ckpt=FILE places=FILE"
        ),
        Command("simulate", f"{ROOM}simulate", "ray-trace a dataset with the effects it needs: out=FILE"),
        Command("study", f"{ROOM}study", "variants of one model: kind=effects, positions or measurements"),
        Command("tradeoff", f"{ROOM}tradeoff", "accuracy against latency of one model: ckpt=FILE"),
        Command("compare", f"{ROOM}compare", "every method under the same data, metrics and clock"),
        Command(
            "calibrate",
            f"{ROOM}calibrate",
            "compare confidences; a threshold with a bounded risk: ckpt=FILE",
        ),
        Command("link", f"{ROOM}link.command", "rates and block errors with predicted channels: ckpt=FILE"),
        Command("map", f"{ROOM}map", "received power over an area with a promised error: ckpt=FILE"),
        Command("view", f"{ROOM}view", "the field in three dimensions, in a browser or saved: ckpt=FILE"),
        Command(
            "plan", f"{ROOM}plan", "where to measure next: ckpt=FILE, or area=... before anything is measured"
        ),
        Command("place", f"{ROOM}place", "where one more station serves an area best: ckpt=FILE"),
        Command("llvm", "gsparc.simulate.llvm", "fetch the LLVM that ray tracing needs", configured=False),
        Command("report", f"{ROOM}report", "one page about many runs: RUN...", "runs"),
        Command("bench", f"{ROOM}bench.command", "timings of kernels as ratios to the machine's limit"),
    )
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
