"""The commands of `gsparc`, where each lives, and what it answers in one line."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module


@dataclass(frozen=True)
class Command:
    """One command, whose module is `gsparc.commands.<name>`.

    Attributes:
        name: also of its configuration, `conf/<name>.yaml`.
        answers: one line for the list.
        bare: setting that takes words without an equals sign, as a list of paths.
        configured: False for a command without a configuration: its module has `main(arguments)`.
    """

    name: str
    answers: str
    bare: str | None = None
    configured: bool = True

    def arguments(self, words: Sequence[str]) -> list[str]:
        """Return a command line in Hydra's words: bare paths become `<bare>=[...]`."""
        paths = [
            word for word in words if self.bare and "=" not in word and not word.startswith("-")
        ]
        # Quoted in Hydra's grammar, as paths may hold spaces, commas and brackets.
        quoted = ",".join("'" + path.replace("'", "\\'") + "'" for path in paths)
        return [
            *(word for word in words if word not in paths),
            *[f"{self.bare}=[{quoted}]"] * bool(paths),
        ]

    def run(self) -> None:
        """Run it with the command line in `sys.argv`; ends the process when it fails."""
        path = f"gsparc.commands.{self.name}"
        if not self.configured:
            sys.exit(import_module(path).main(sys.argv[1:]))
        from gsparc.commands.shared import cli

        if {"--help", "-h"} & {*sys.argv[1:]}:  # before torch is imported
            sys.stdout.write(cli.help_text(self.answers, self.name))
        else:
            # Imported, with torch, once the words are understood.
            cli.run(lambda config: import_module(path).task(config), self.name)


COMMANDS = {
    command.name: command
    for command in (
        Command("train", "train a method on a dataset and test it beside baselines"),
        Command("evaluate", "test a checkpoint again: ckpt=FILE"),
        Command(
            "check", "what is in files of measurements, or what is wrong: FILE...", configured=False
        ),
        Command(
            "data", "public sets of measurements: listed, or fetched by NAME", configured=False
        ),
        Command("predict", "predictions at places of a table: ckpt=FILE places=FILE"),
        Command("simulate", "ray-trace a dataset with the effects it needs: out=FILE"),
        Command("study", "variants of one model: kind=effects, positions or measurements"),
        Command("tradeoff", "accuracy against latency of one model: ckpt=FILE"),
        Command("compare", "every method under the same data, metrics and clock"),
        Command("calibrate", "a confidence, and a threshold with a bounded risk: ckpt=FILE"),
        Command("link", "rates and block errors with predicted channels: ckpt=FILE"),
        Command(
            "update", "a model with rows that came later, and what changed: ckpt=FILE data=FILE"
        ),
        Command("export", "the model for other programs: ckpt=FILE to=c, taps, deepmimo"),
        Command("serve", "answers over HTTP: ckpt=FILE"),
        Command("locate", "where rows were heard, by the field's likelihood: ckpt=FILE"),
        Command("map", "received power over an area with a promised error: ckpt=FILE"),
        Command("view", "the field in three dimensions, in a browser or saved: ckpt=FILE"),
        Command(
            "plan", "where to measure next: ckpt=FILE, or area=... before anything is measured"
        ),
        Command("audit", "does a published map hold, and where to drive to tell: claim=FILE"),
        Command("place", "where one more station serves an area best: ckpt=FILE"),
        Command("report", "one page about many runs: RUN...", bare="runs"),
        Command("bench", "seconds of kernels beside plain PyTorch"),
    )
}


def list_commands() -> str:
    """List all commands with one line each."""
    width = max(map(len, COMMANDS))
    rows = "".join(f"  {name:<{width}}  {command.answers}\n" for name, command in COMMANDS.items())
    return (
        f"gsparc COMMAND key=value ...\n\n{rows}\n`gsparc COMMAND --help` lists a command's "
        "settings.\n"
    )


def suggest_command(name: str) -> str:
    """Return `; did you mean 'train'?`, or what there is."""
    # Below difflib's 0.6, as names of commands are short: one letter is a large share.
    close = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(COMMANDS)}"
