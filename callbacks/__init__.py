"""Lightning callbacks: densify and prune, opacity reset, cost ledger, pictures."""

from gsparc.callbacks.densify import Densify
from gsparc.callbacks.ledger import CostLedger
from gsparc.callbacks.pictures import Pictures
from gsparc.callbacks.progress import StepProgress
from gsparc.callbacks.reset import OpacityReset

__all__ = ["CostLedger", "Densify", "OpacityReset", "Pictures", "StepProgress"]
