"""Terms of the covariance of channels, one in one file; `gsparc.models.channels.prior` sums them.

A new one says its covariance and variance (`term.ChannelTerm`), is named in `KINDS` to be stored,
and is tried in `gsparc.models.channels.initial`.
"""

from gsparc.models.channels.terms.direct import Direct
from gsparc.models.channels.terms.directions import Directions
from gsparc.models.channels.terms.drift import Drift
from gsparc.models.channels.terms.images import Images
from gsparc.models.channels.terms.isotropic import Isotropic
from gsparc.models.channels.terms.leakage import Leakage
from gsparc.models.channels.terms.noise import Noise

__all__ = ["KINDS", "Direct", "Directions", "Drift", "Images", "Isotropic", "Leakage", "Noise"]

# In the order of their powers
KINDS = (Isotropic, Directions, Leakage, Direct, Images, Noise, Drift)
