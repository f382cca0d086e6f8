"""Where the figures of bench/gpu.sh go: one JSON file, section by section."""

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
    unfinished.replace(file)  # a stage that is ended here leaves what was known
    LOG.info("%s", json.dumps(sections))


def told(*command: str) -> str:
    """What a program prints, or nothing where there is none such."""
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


def guarded(section: Callable[[], Any]) -> Any:
    """What a section measured, or its error: one failure must not cost the others."""
    try:
        return section()
    except Exception as error:
        LOG.error("%s", traceback.format_exc())
        return {"error": f"{type(error).__name__}: {error}"}
