"""`gsparc study kind=effects|positions ...`: variants of one model on the same data."""

from __future__ import annotations

import sys

from gsparc.studies.study import prices, sensitivity

KINDS = {"effects": prices.main, "positions": sensitivity.main}


def main() -> None:
    """Entry point."""
    kind = next((word.removeprefix("kind=") for word in sys.argv if word.startswith("kind=")), "effects")
    sys.argv = [word for word in sys.argv if not word.startswith("kind=")]
    if kind not in KINDS:
        sys.stderr.write(f"error: kind={kind}: choose {' or '.join(KINDS)}\n")
        sys.exit(1)
    KINDS[kind]()
