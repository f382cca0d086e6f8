"""`gsparc COMMAND key=value ...`."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version

from gsparc.commands.listing import COMMANDS, list_commands, suggest_command

READER_LEFT = 141  # a shell's status of a process that wrote to a closed pipe


def main() -> None:
    """Run the command named first; without one, list them.
    Exit status 0 only when the job was done.
    """
    try:
        try:
            _run()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # `| head` has its lines
        # The interpreter flushes once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(READER_LEFT)
    except KeyboardInterrupt:  # while modules are loaded: cli.run says the others
        sys.stderr.write("error: interrupted\n")
        sys.exit(130)


def _run() -> None:
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("--help", "-h", "help"):
        sys.stdout.write(list_commands())
        return
    if name == "--version":
        sys.stdout.write(f"gsparc {version('gsparc')}\n")
        return
    if name not in COMMANDS:
        sys.stderr.write(f"error: no command is called {name!r}{suggest_command(name)}\n")
        sys.exit(1)
    command = COMMANDS[name]
    sys.argv = [f"gsparc {name}", *command.arguments(sys.argv[2:])]
    command.run()


if __name__ == "__main__":
    main()
