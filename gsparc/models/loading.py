"""The model in a checkpoint: of whatever class it is, with its stations,
or as a module of Lightning's.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hydra.utils import get_class

from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.models.gsparc import Gsparc
from gsparc.models.method import Method, MethodFactory, import_path
from gsparc.models.per_station import PerStation
from gsparc.models.registry import all_methods, build
from gsparc.models.sanity import create_unfitted
from gsparc.models.splat.method import LearnedField
from gsparc.models.updated import stored_changes, with_changes

if TYPE_CHECKING:
    from gsparc.field.module import GaussianModule


def method_from_checkpoint(stored: checkpoint.StoredModel) -> Method:
    """Return the fitted method a checkpoint holds; only classes of gsparc are built.

    Raises:
        CheckpointError: unknown method, or a state that does not fit it.
    """
    model = stored.configuration.get("model")
    try:
        # Of `gsparc` the file names the method that was made, its configuration who made it.
        makers = stored.target, import_path(Gsparc)
        if isinstance(model, dict) and model.get("_target_") in makers:
            factory = build(model, trusted=False)
        elif stored.target in all_methods().values():
            factory = get_class(stored.target)()
        else:
            raise CheckpointError(
                f"{stored.path}: made by {stored.target!r}, which no gsparc or plugin here knows"
            )
        return rebuild_method(factory, stored)
    except CheckpointError:
        raise
    except Exception as error:  # the state comes from a file: anything may be wrong with it
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(
            f"{stored.path}: {stored.method} cannot be restored ({reason})"
        ) from error


def rebuild_method(factory: MethodFactory, stored: checkpoint.StoredModel) -> Method:
    """Return what `factory` makes of the stored class, or one for each station,
    with a stored state.
    """
    several = "per_station" in stored.state
    method = PerStation(factory) if several else create_unfitted(factory, stored.target)
    method.restore(stored.site, stored.state)
    method.name = stored.method
    return method


def load(path: str | Path | checkpoint.StoredModel) -> tuple[Method, checkpoint.StoredModel]:
    """Return the model of a file, or of what was read of it, with later rows,
    and what else it holds.

    Raises:
        CheckpointError: as these two.
    """
    stored = path if isinstance(path, checkpoint.StoredModel) else checkpoint.read(path)
    return with_changes(
        method_from_checkpoint(stored), stored_changes(stored.extra, stored.path)
    ), stored


def load_module(path: str | Path) -> GaussianModule:
    """Return the LightningModule in a `model.ckpt` or `last.ckpt` of a splatted field, on the CPU.

    Raises:
        CheckpointError: unreadable, or another method's.
    """
    # Here, as it imports Lightning: two seconds, which `load` does without.
    from gsparc.models.gradient import make_module

    method, stored = load(path)
    if not isinstance(method, LearnedField):
        raise CheckpointError(f"{path}: {stored.method} holds no Gaussian field")
    return make_module(method)
