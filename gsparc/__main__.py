"""`gsparc COMMAND key=value ...`."""

from __future__ import annotations

import sys

from gsparc.commands.listing import COMMANDS, listed, nearest


def main() -> None:
    """Run the command named first; without one, list them. Exit status 0 only when the job was done."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("--help", "-h", "help"):
        sys.stdout.write(listed())
        return
    if name not in COMMANDS:
        sys.stderr.write(f"error: no command is called {name!r}{nearest(name)}\n")
        sys.exit(1)
    command = COMMANDS[name]
    sys.argv = [f"gsparc {name}", *command.arguments(sys.argv[2:])]
    command.run()


if __name__ == "__main__":
    main()
