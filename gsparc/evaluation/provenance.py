"""Which program made a result: its commit, and versions of what matters."""

from __future__ import annotations

import functools
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from uuid import uuid4

PACKAGES = (
    "gsparc",
    "torch",
    "lightning",
    "hydra-core",
    "numpy",
    "scipy",
    "scikit-learn",
    "scikit-image",
)


def new_run_id() -> str:
    """Return what all files of a run carry, so that those of two are not read together;
    sorts by time.
    """
    # 8 digits of a random id: two jobs of a sweep may begin in one second.
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{uuid4().hex[:8]}"


@functools.cache  # of a process, which runs what it has read
def provenance() -> dict[str, str | None]:
    """Return `git`: commit of the source tree (`-dirty` when edited, None outside one).

    `versions`: what matters.
    """
    return {"git": _git(), "versions": _versions()}


def program_version(origin: Mapping[str, str | None]) -> str:
    """Return `gsparc 0.1.0`, and the commit of `provenance()` where there is a source tree."""
    commit = origin["git"]
    return f"gsparc {version('gsparc')}" + (f" at commit {commit[:8]}" if commit else "")


def run_git(folder: Path, *arguments: str) -> str | None:
    """Return what git says in a folder, None where it fails."""
    # `git status` would lock the index to refresh it,
    # and a run that is killed then leaves the lock.
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return process.stdout.strip() if process.returncode == 0 else None


def _git() -> str | None:
    source = Path(__file__).resolve()
    # None in an installed copy inside someone else's tree.
    if run_git(source.parent, "ls-files", "--error-unmatch", source.name) is None:
        return None
    commit = run_git(source.parent, "rev-parse", "HEAD")
    # Untracked files are mostly results of runs: with them every tree would count as edited.
    edited = commit and run_git(source.parent, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if edited else commit


def _versions() -> str:
    versions = [f"python {platform.python_version()}"]
    for package in PACKAGES:
        # Extras may be missing: versions are of what is there.
        with suppress(PackageNotFoundError):
            versions.append(f"{package} {version(package)}")
    return ", ".join(versions)
