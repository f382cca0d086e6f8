"""`gsparc COMMAND key=value ...`, also `python -m gsparc COMMAND key=value ...`."""

from __future__ import annotations

import sys
from importlib import import_module

from gsparc.studies.commands import COMMANDS, listed, nearest


def main() -> None:
    """Run the command named first; without one, list them."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("--help", "-h", "help"):
        sys.stdout.write(listed())
        return
    if name not in COMMANDS:
        sys.stderr.write(f"error: no command is called {name!r}{nearest(name)}\n")
        sys.exit(1)
    sys.argv = [f"gsparc {name}", *sys.argv[2:]]
    import_module(COMMANDS[name].module).main()


if __name__ == "__main__":
    main()
