"""The file of a model that rows are told to while it answers."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from threading import Lock
from typing import Any

from gsparc.data.schema import Site
from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.updating import Found, versions_extra


class ToldFile:
    """What answers is what the file holds: rows that cannot be written are not told,
    those of others are.

    Args:
        stored: what the file held when the model was loaded.
        load: makes a model of what a file holds.
    """

    def __init__(
        self, stored: checkpoint.StoredModel, load: Callable[[checkpoint.StoredModel], Predictor]
    ) -> None:
        self.path, self.load, self._sha256 = stored.path, load, stored.sha256

    def tell(self, predictor: Predictor, asked: Lock, wait_s: float, **rows: Any) -> Found:
        """Add rows to the file, then to the predictor; one thread at a time.

        Args:
            predictor: answers, and becomes what the file then holds.
            asked: held while it answers.
            wait_s: for others who write the file.
            **rows: see `Predictor.update`.

        Raises:
            CheckpointError: the file cannot be written, or holds another model now; nothing is
                changed.
            ValueError: as `Predictor.update` does.
        """
        with checkpoint.rewriting(self.path, wait_s=wait_s) as file:
            told = copy(predictor)
            # Another process told it rows, or trained it again
            if file.stored.sha256 != self._sha256:
                told = self.load(file.stored)
                if _facts(told.site) != _facts(predictor.site):
                    other = (
                        f"{self.path}: holds a model of other stations now; start the server again"
                    )
                    raise CheckpointError(other)
            answer = told.update(**rows)
            file.store(versions_extra(told.versions))
        self._sha256 = file.stored.sha256
        with asked:
            vars(predictor).update(vars(told))
        return answer


def _facts(site: Site) -> tuple[Any, ...]:
    """What clients count on."""
    return site.kind, site.moving_end, site.every_station.shown
