"""Work that says nothing in a test, left out or done once for all of them."""

import pickle
import sys
from functools import cache
from importlib import import_module

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from PIL import Image

from gsparc.data import instantiate, load
from gsparc.evaluation import summary
from gsparc.prediction.timing import ClockSettings


def compose_once(patch) -> None:
    """Files of settings are parsed once: composing takes 45 ms of the processor instead of 90."""
    Plugins.instance()  # which imports the class anew
    source_of = import_module("hydra._internal.core_plugins.importlib_resources_config_source")
    defaults = import_module("hydra._internal.defaults_list")
    source_class, every_choice = source_of.ImportlibResourcesConfigSource, defaults._create_interpolation_map
    read, known = source_class._read_config, {}

    def once(source, file):
        key = source.provider, str(file)
        if not source.path.startswith(("gsparc.", "hydra.")):  # a plugin's may change
            return read(source, file)
        if key not in known:
            known[key] = pickle.dumps(read(source, file))
        return pickle.loads(known[key])  # a tenth of `deepcopy`

    def if_asked(overrides, items, self_added):
        asked = any(one.is_interpolation() for one in items)
        return every_choice(overrides, items, self_added) if asked else None

    patch.setattr(source_class, "_read_config", once)
    patch.setattr(defaults, "_create_interpolation_map", if_asked)
    # Every composing copied the store of all classes, and changes none of it.
    patch.setattr(ConfigStore, "__deepcopy__", lambda store, memo: store, raising=False)


def look_once(patch) -> None:
    """Notes of installed packages, files of datasets and what git says: 60 ms of every training."""
    scan = cache(lambda path, group, read=instantiate.entry_points: read(group=group))
    patch.setattr(instantiate, "entry_points", lambda group: scan(tuple(sys.path), group))
    for module, name in ((load, "_choices"), (summary, "_git"), (summary, "_versions")):
        patch.setattr(module, name, cache(getattr(module, name)))


def time_and_draw_less(patch) -> None:
    """Pictures and sixty rounds of timed queries beside a copy of 16 MiB were half of a training."""

    def dot(method, data, fold, title, path):
        Image.new("L", (1, 1)).save(path)  # what loggers are given

    patch.setattr("gsparc.evaluation.pictures.draw_predictions", dot)
    patch.setattr("gsparc.evaluation.evaluate.ClockSettings", lambda: ClockSettings(5, least=2, warmup=1))
    patch.setattr("gsparc.prediction.timing.COPY_BYTES", 2**12)
