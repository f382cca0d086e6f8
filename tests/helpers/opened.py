"""What a process that is started with arrays got; without heavy imports, which it would repeat."""

from pathlib import Path

import numpy as np


def say(file: Path, *arrays: np.ndarray) -> None:
    """Write whether each has a file of its own, and what is in it."""
    file.write_text(
        "\n".join(f"{getattr(one, 'file', None) is not None} {one.tolist()}" for one in arrays)
    )
