"""Whether several stations are learned in one field or each in its own, where nobody says."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.method import MethodFactory
from gsparc.models.powers.own_terms import OwnTerms
from gsparc.models.powers.together.links import both_ends_move
from gsparc.models.powers.together.network import find_sectors
from gsparc.models.target_rows import heard_rows
from gsparc.training.context import FitContext

ONE_FACTOR = 6_000  # rows: a covariance of more is not factored as one


class LearnsTogether(MethodFactory):
    """Learns several stations of a site in one field, or each in its own."""

    both_ends = True
    takes_effort = True
    init: InitSettings
    own_terms = OwnTerms()

    def learns_jointly(self, site: Site) -> bool:
        """Tell whether stations share a field: of powers,
        or channels of a known carrier with phases.
        """
        waves = site.has_waves and not site.paired
        return (waves and site.phase_reference != "neighbours") or site.target.is_level

    def why_each(self, data: Measurements) -> str | None:
        """Return why several stations cannot be learned together; None where they can."""
        own = self.own_terms
        if own.terms:
            return "model.terms are of one station's model"
        unaimed = own.prior is not None and find_sectors(data) is None
        return (
            ("model.prior is of one station's model, or of a network with azimuths")
            if unaimed
            else None
        )

    def choose_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """See `Method.choose_stations`.

        Channels share waves and where their stations really stand,
        powers a law that few rows of one tell.
        """
        if (why := self.why_each(data)) is not None:
            return "each", why
        if not self.learns_jointly(data.site) or self.init.name == "scene":
            return "each", ""
        if data.site.target.is_image:
            return "together", "carriers at one place have the same paths"
        if data.site.target.is_complex:
            return "together", "channels at all stations share waves and the frame of places"
        if not np.isin(data.stations_of(fold.test), data.stations_of(fold.train)).any() and len(
            fold.test
        ):
            return (
                "together",
                "no station of the test rows was heard: what stations share answers for them",
            )
        rows = heard_rows(data, fold.learned())
        if both_ends_move(data, rows):
            return "together", "both ends move: links between near places are alike"
        if len(rows) > ONE_FACTOR:
            return "each", f"{len(rows)} rows are more than one factor holds ({ONE_FACTOR})"
        if find_sectors(data) is not None:
            return "together", (
                "sectors of a network share a law, a pattern and the shadowing of their sites"
            )
        return "together", "powers at all stations share a law of distance"
