"""Lightning's checkpoints inside ours: one file that `gsparc.load` reads
and `ckpt_path=` resumes from.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch.plugins.io import CheckpointIO

from gsparc.models import checkpoint

if TYPE_CHECKING:
    from gsparc.models.method import Method


def read_interrupted(path: Path) -> checkpoint.StoredModel:
    """Return what an interrupted training left.

    Raises:
        ValueError: when the file holds a finished model without a trainer's state, or one that is
            not finite.
    """
    stored = checkpoint.read(path)
    if "trainer" not in stored.extra:
        raise ValueError(
            f"{path} holds a finished model, not a training state: resume from last.ckpt instead"
        )
    trainer = {**stored.extra["trainer"], "earlier_s": stored.extra.get("earlier_s")}
    callbacks = trainer.pop("callbacks", None)  # whose best score begins at infinity
    wrong = checkpoint.find_non_finite(trainer, "trainer")
    wrong = wrong or checkpoint.find_non_finite(callbacks, "trainer.callbacks", infinite=True)
    if wrong is not None:
        raise checkpoint.CheckpointError(
            f"{path}: {wrong} is NaN or infinite; resume from an earlier file"
        )
    return stored


class GsparcCheckpointIO(CheckpointIO):
    """Writes a method's checkpoint with the trainer's state beside it, atomically.

    Args:
        method: what is being trained.
        config_yaml: the whole configuration as text.
        marks: what else a resumed run must know (which stage, seconds spent before it).
    """

    def __init__(self, method: Method, config_yaml: str, marks: Mapping[str, Any]) -> None:
        self.method, self.config_yaml, self.marks = method, config_yaml, dict(marks)

    def save_checkpoint(
        self, trainer_state: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write atomically; nowhere where a fit has no folder."""
        extra = {"trainer": trainer_state, **self.marks}
        if Path(path).parent != Path():
            checkpoint.save(Path(path), self.method, self.config_yaml, extra)

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return the trainer's part of a checkpoint.

        Raises:
            ValueError: when the file holds a finished model without a trainer's state.
        """
        return read_interrupted(Path(path)).extra["trainer"]

    def remove_checkpoint(self, path: Any) -> None:
        """Delete a superseded checkpoint."""
        Path(path).unlink(missing_ok=True)
