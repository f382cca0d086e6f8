"""A field of powers whose settings are known, to be conditioned."""

import numpy as np

from gsparc.data.schema import Site
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.learning import StationPriors
from gsparc.models.powers.together.terms import SharedTerms


def known_field(
    site: Site, places: np.ndarray, own: StationPriors, terms: SharedTerms
) -> JointPowerField:
    """Return one whose stations share `terms`."""
    result = JointPowerField()
    result.site, result.places, result.own = site, places, own
    result.heard = result.unheard = terms
    return result
