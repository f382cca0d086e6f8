"""Work that says nothing in a test, left out or done once for all of them."""

import sys
from functools import cache

from PIL import Image

from gsparc.base import instantiate
from gsparc.datasets import load
from gsparc.evaluation import provenance
from gsparc.prediction.timing import ClockSettings


def look_once(patch) -> None:
    """Notes of installed packages, files of datasets and what git says: 60 ms of every training."""
    scan = cache(lambda path, group, read=instantiate.entry_points: read(group=group))
    patch.setattr(instantiate, "entry_points", lambda group: scan(tuple(sys.path), group))
    for module, name in ((load, "_choices"), (provenance, "_git"), (provenance, "_versions")):
        patch.setattr(module, name, cache(getattr(module, name)))


def time_and_draw_less(patch) -> None:
    """Pictures and sixty rounds of timed queries beside a copy
    of 16 MiB were half of a training.
    """

    def dot(method, data, rows, examples, title, path):
        Image.new("L", (1, 1)).save(path)  # what loggers are given

    patch.setattr("gsparc.pictures.pictures.draw_predictions", dot)
    patch.setattr("gsparc.runs.evaluate.ClockSettings", lambda: ClockSettings(5, least=2, warmup=1))
    patch.setattr("gsparc.prediction.timing.COPY_BYTES", 2**12)
