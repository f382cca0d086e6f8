"""The JSON file of bench/gpu.sh's results, written section by section."""

from __future__ import annotations

import json
import logging
import subprocess
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

LOG = logging.getLogger("gpu")


def update(file: Path, **sections: Any) -> None:
    """Merge sections into the JSON file."""
    known = json.loads(file.read_text()) if file.exists() else {}
    unfinished = file.with_suffix(".part")
    unfinished.write_text(json.dumps(known | sections, indent=1))
    unfinished.replace(file)  # atomic: a stage that is killed here leaves the earlier sections
    LOG.info("%s", json.dumps(sections))


def output_of(*command: str) -> str:
    """Standard output of a program, empty if it is not installed."""
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


def guarded(section: Callable[[], Any]) -> Any:
    """Result of a section, or its error, so that the other sections still run."""
    try:
        return section()
    except Exception as error:
        LOG.error("%s", traceback.format_exc())
        return {"error": f"{type(error).__name__}: {error}"}
