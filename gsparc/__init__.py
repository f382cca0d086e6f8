"""GSpaRC: Gaussian splatting for radio. See ARCHITECTURE.md for a map;
`gsparc.ops` is the folder `ops/`.

>>> import gsparc
>>> predictor = gsparc.load("model.ckpt")  # or gsparc.fit(rx=..., tx=..., rssi=...)
>>> predictor.rssi(rx=[[2.0, 1.0, 1.5], [3.0, 1.0, 1.5]]).shape  # two places [m], one transmitter
(2, 1)
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsparc.ops import Pose as Pose
    from gsparc.ops import SphereGrid as SphereGrid
    from gsparc.prediction.fit import fit as fit
    from gsparc.prediction.operating_point import load as load
    from gsparc.prediction.predictor import Predictor as Predictor

# Torch's threads would otherwise spin for one another and against our kernels' own: up to twice
# slower, and twenty times beside another busy process.
# It works where gsparc is imported before torch.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Looked up on first use: `import gsparc` costs nothing.
_PUBLIC = {
    "fit": "gsparc.prediction.fit",
    "load": "gsparc.prediction.operating_point",
    "Predictor": "gsparc.prediction.predictor",
    "Pose": "gsparc.ops",
    "SphereGrid": "gsparc.ops",
}
__all__ = ["Pose", "Predictor", "SphereGrid", "fit", "load"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("gsparc")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsparc' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
