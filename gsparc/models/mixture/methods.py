"""What is solved in closed form for which kind of site, each under its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.mixture.candidates import CANDIDATES, Candidate, make_bearings
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.powers.own_terms import OwnTerms, to_terms
from gsparc.models.terms import array_obstacle, phase_obstacle
from gsparc.training.context import FitContext, FitReport

# Of a moving array, up to which sources may be worth less than the plain process
PROCESS_ROWS = 1_000


def _candidates(*names: str) -> dict[str, Candidate]:
    return {name: CANDIDATES[name] for name in names}


class ImageSources(Mixture):
    """Image sources, found by searches or along measured directions, beside a process of waves."""

    name = "image_sources"

    def list_candidates(self, data: Measurements) -> Mapping[str, Candidate]:
        """See `Mixture`."""
        searched = ("sources", "rays") if data.directions is not None else ("sources",)
        placed = (str(self.init.name),) if self.init.name in CANDIDATES else searched
        # Offsets are known to sources alone.
        adds_diffuse = self.init.snapshot == "none" and self.adds_process
        return _candidates(*placed, *(["diffuse"] if adds_diffuse else []))

    def why_not(self, data: Measurements) -> str | None:
        """See `Mixture`."""
        return phase_obstacle(data)


class Channels(Mixture):
    """Leakage, a direct wave and waves from all around; where rows were turned to each other,
    a process.
    """

    name = "channels"

    def list_candidates(self, data: Measurements) -> Mapping[str, Candidate]:
        """See `Mixture`; no phase tells of paths where rows have phases of their own."""
        if data.site.phase_reference == "neighbours":
            return _candidates("aligned", "neighbours", "process")
        return _candidates("diffuse")

    def why_not(self, data: Measurements) -> str | None:
        """See `Mixture`."""
        return (
            None
            if data.site.target.is_complex
            else (f"the target is {data.site.kind}, not channels")
        )


class Powers(Mixture):
    """A process of decibels about a distance law; of several stations, about a law of the site.

    Args:
        *settings: of `Mixture`.
        terms, prior: see `OwnTerms`.
        **named: see `settings`.
    """

    name = "powers"
    uses_censored = True

    def __init__(
        self,
        *settings: Any,
        terms: Sequence[Any] = (),
        prior: str | Path | None = None,
        **named_settings: Any,
    ) -> None:
        super().__init__(*settings, **named_settings)
        self.own_terms = OwnTerms(to_terms(terms), prior)

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `Mixture`, with terms of the user's own."""
        return super().fit(data, fold, replace(context, terms=self.own_terms.columns(data)))

    def list_candidates(self, data: Measurements) -> Mapping[str, Candidate]:
        """See `Mixture`; `init=scene` is the process of one station that knows walls."""
        if self.init.name == "scene":
            return {"scene": CANDIDATES["powers"]}
        return _candidates("joint_powers" if data.site.several else "powers")

    def why_not(self, data: Measurements) -> str | None:
        """See `Mixture`."""
        if data.site.several and (why := self.why_each(data)) is not None:
            return f"{why}; say stations=each"
        return (
            None
            if data.site.target.is_level
            else (f"the target is {data.site.kind}, not received powers")
        )


class Bearings(Mixture):
    """Sources where bearings of a moving array cross, with processes of powers,
    beside the plain process.
    """

    name = "bearings"

    def list_candidates(self, data: Measurements) -> Mapping[str, Candidate]:
        """See `Mixture`."""
        if not self.adds_process:
            return {"bearings": partial(make_bearings, components=0)}
        return _candidates("bearings", *(["process"] if len(data) <= PROCESS_ROWS else []))

    def why_not(self, data: Measurements) -> str | None:
        """See `Mixture`."""
        return array_obstacle(data.site, "tx", "the receiver stands still")
