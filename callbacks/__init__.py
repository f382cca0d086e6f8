"""Lightning callbacks: densify and prune, bounds, opacity reset, checkpoint, cost ledger,
pictures.
"""

from gsparc.callbacks.bounds import Bounds
from gsparc.callbacks.checkpoint import Checkpoint
from gsparc.callbacks.densify import Densify
from gsparc.callbacks.ledger import CostLedger
from gsparc.callbacks.pictures import Pictures
from gsparc.callbacks.progress import StepProgress
from gsparc.callbacks.reset import OpacityReset

__all__ = [
    "Bounds",
    "Checkpoint",
    "CostLedger",
    "Densify",
    "OpacityReset",
    "Pictures",
    "StepProgress",
]
