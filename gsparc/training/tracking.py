"""Dashboards: Weights & Biases, which stays offline unless its user has logged in, and TensorBoard."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger


def wandb_logger(offline: bool | None = None, **settings: Any) -> WandbLogger:
    """A logger for `logger=wandb`.

    Args:
        offline: None keeps the run on disk (`wandb sync` sends it later) unless `wandb login` was done.
        **settings: of Lightning's `WandbLogger`.
    """
    import wandb  # slow to import, and few runs need it
    from lightning.pytorch.loggers import WandbLogger

    stays = not wandb.login(prompt=False) if offline is None else offline
    # Lightning sets a variable that wandb, once asked for a login, does not read again.
    mode: dict[str, Any] = {"mode": "offline"} if stays else {}
    return WandbLogger(offline=stays, **mode, **settings)


def tensorboard_logger(save_dir: str, name: str = "tensorboard") -> TensorBoardLogger:
    """A logger for `logger=tensorboard`; event files go to `save_dir/name`.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    from lightning.pytorch.loggers import TensorBoardLogger

    try:
        return TensorBoardLogger(save_dir, name=name, version="")
    except ModuleNotFoundError:
        raise ValueError(
            'logger=tensorboard: TensorBoard is not installed; say pip install "gsparc[tensorboard]"'
        ) from None
