"""What every method is (`Method`), what some can do besides,
and what they predict (`Prediction`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from gsparc.base.instantiate import accepted_arguments
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.data.target import Kind
from gsparc.models.abilities import HasJoint
from gsparc.physics.decibels import RELATIVE_DB, from_decibels
from gsparc.processes.stored import from_plain, to_plain
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort

if TYPE_CHECKING:
    pass

T = TypeVar("T")
MEAN_DEVICE = -1  # number of the device that nobody named, see `Site.device_levels`
DOUBLE = {torch.float32: torch.float64, torch.complex64: torch.complex128}


@dataclass(frozen=True)
class Prediction:
    """What is said about B queries, in the units of the stored targets.

    Attributes:
        mean: (B, H, W) float32 in [0, 1], (B, antennas, subcarriers) complex64, or (B, 1) float32;
            all of it in double precision where positions are float64, see
            `Method.gradient_problem`.
        variance: (B,) float32, expected squared error per entry; None when the method has none.
        unknown: (B,) float32 in [0, 1], share of the prior variance that training left: near 0 at
            training rows, 1 far from all of them; None when the method does not say. Confidence is
            1 minus it.
        explained: like the mean, its share that Gaussians predict; None where that is not told
            apart.
    """

    mean: Tensor
    variance: Tensor | None = None
    unknown: Tensor | None = None
    explained: Tensor | None = None

    @property
    def confidence(self) -> Tensor | None:
        """Return 1 - `unknown`, (B,) in [0, 1]: larger is surer."""
        return None if self.unknown is None else (1 - self.unknown).clamp(0, 1)

    @property
    def deviation(self) -> Tensor | None:
        """Return root mean square errors of an entry, float32, with as many axes as the mean."""
        if self.variance is None:
            return None
        axes = [1] * (self.mean.ndim - self.variance.ndim)
        return self.variance.sqrt().float().reshape(*self.variance.shape, *axes)

    def of_devices(
        self,
        site: Site,
        device: Tensor | int = MEAN_DEVICE,
        station: Tensor | int | None = None,
    ) -> Prediction:
        """Return what devices (B,), or one, would read, where this is the mean one's;
        variances add.

        Stations (B,), or one, are those of the rows; None: the mean of all.
        """
        if site.device_levels is None:
            return self
        table, device = torch.from_numpy(site.device_levels), torch.as_tensor(device)
        table = table.reshape(-1, *table.shape[-2:])  # stored before stations had their own
        levels = table.mean(0)[device] if station is None else table[station, device]
        levels, axes = levels.reshape(-1, 2), (-1, *[1] * (self.mean.ndim - 1))
        factor = from_decibels(levels[:, 0]).to(self.mean.dtype)
        spread = levels[:, 1].to(self.mean.dtype)
        many = factor.reshape(axes)
        mean, variance, explained = self.mean * many, self.variance, self.explained
        if variance is not None:
            device_variance = (mean / RELATIVE_DB).square() * spread.reshape(many.shape)
            # One of all entries, or each its own
            scale = factor.square().reshape(-1, *[1] * (variance.ndim - 1))
            variance = variance * scale + device_variance.reshape(variance.shape)
        return Prediction(
            mean, variance, self.unknown, None if explained is None else explained * many
        )

    def map(self, change: Callable[[Tensor], Tensor]) -> Prediction:
        """Return the same, each of its parts changed."""
        parts = (getattr(self, field.name) for field in fields(self))
        return Prediction(*(None if part is None else change(part) for part in parts))  # type: ignore[arg-type]

    @staticmethod
    def joined(parts: Sequence[Prediction], order: Tensor | None = None) -> Prediction:
        """Return one after the other, then in an order (B,); what any part lacks is None."""
        if len(parts) == 1 and order is None:
            return parts[0]

        def join_field(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            if any(value is None for value in values):
                return None
            return torch.cat(values) if order is None else torch.cat(values)[order]

        return Prediction(*(join_field(field.name) for field in fields(Prediction)))


class MethodFactory(ABC):
    """Makes unfitted methods, and says what holds for all
    of them before any measurements are seen.
    """

    name: str  # of its methods, as it appears in tables
    guesses: tuple[str, ...] = ()  # settings that the source of a configuration does not give
    both_ends = False  # whether both ends may move: its query is then (tx, rx)
    # Whether it learns from rows where nothing was heard (`Measurements.censored`)
    uses_censored = False
    resumable = False  # whether it goes on from what an interrupted run left (`FitContext.resume`)
    has_parts = False  # whether it resumes parts in folders of their own
    takes_effort = False  # whether `FitContext.effort` changes its fit
    # Whether its training may start from another model's (`FitContext.init_from`)
    takes_weights = False
    # Place in tables of a baseline, which a reader could have without gsparc; of this class alone.
    baseline_order: ClassVar[int | None] = None
    # Of data beside whose other methods it stands; empty for all
    kinds: ClassVar[tuple[Kind, ...]] = ()

    @abstractmethod
    def create_for(self, data: Measurements) -> Method:
        """Return an unfitted method for measurements; their targets are not looked at.

        Raises:
            ValueError: none serves them as configured.
        """

    @abstractmethod
    def create_as(self, target: str) -> Method:
        """Return an unfitted method of the class that a checkpoint names, with these settings.

        Raises:
            ValueError: this makes none of that class.
        """

    @classmethod
    def stands_beside(cls, data: Measurements, fold: Fold) -> bool:
        """Tell whether it is fitted beside others on these rows."""
        return not cls.kinds or data.site.kind in cls.kinds

    def describe_fit(self, data: Measurements, effort: Effort, steps: int | None = None) -> str:
        """Say how measurements would be learned, before they are; "" where the name says it.

        Args:
            data: measurements; targets are not looked at.
            effort: what is counted where nothing else is asked for.
            steps: of gradient that the Trainer is given; None: it is given none.

        Raises:
            ValueError: none serves them as configured.
        """
        return ""

    def learns_jointly(self, site: Site) -> bool:
        """Tell whether it learns several stations of this site at once,
        told which by `Query.station`.
        """
        return False

    def choose_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """Return how several stations are best learned, and why, one line;
        "" if nothing was to decide.
        """
        return "each", ""


def import_path(kind: type) -> str:
    """Return what a configuration or a checkpoint calls a class."""
    return f"{kind.__module__}.{kind.__qualname__}"


class Method(MethodFactory):
    """fit, predict, save, load; nothing else is asked of a method. Unfitted,
    it makes copies of itself.
    """

    site: Site | None = None  # what was learned from; None before `fit` or `restore`
    # Attributes that a fit finds, by their names in a checkpoint
    stored: ClassVar[tuple[str, ...]] = ()
    effects: str | None = None  # the propagation effects that are computed, for `summary.json`
    # Whether what it learns are Gaussians, which `count_components` then counts
    has_gaussians = False
    # See `gradient_problem`, which others say as they are fitted.
    no_gradient: str | None = "the method does not say that its operations are differentiable"
    threads_pay: bool = (
        False  # whether several threads answer a single place sooner than one: where it renders
    )

    # Groups of settings that its fit follows beside the arguments of its class; `trainer` and
    # `callbacks` among them where it takes steps.
    further_settings: tuple[str, ...] = ()

    def settings_read(self) -> frozenset[str]:
        """Return settings and groups that its fit follows: names below `model`,
        and groups of the run.
        """
        return frozenset((*accepted_arguments(type(self)), *self.further_settings))

    def create_for(self, data: Measurements) -> Method:
        """See `MethodFactory`."""
        return deepcopy(self)

    def create_as(self, target: str) -> Method:
        """See `MethodFactory`."""
        if target != import_path(self.stored_class):
            raise ValueError(f"model={self.name} makes no {target}: train again")
        return deepcopy(self)

    @property
    def is_yardstick(self) -> bool:
        """Whether others are held against it, so that it answers however bad it is:
        plain methods here.
        """
        return vars(type(self)).get("baseline_order") is not None

    @property
    def label(self) -> str:
        """The name as people read it, with how the fit approximates."""
        return self.name

    @property
    def description(self) -> str:
        """What was fitted, in words: under one name a method may be one thing here
        and another there.
        """
        return self.label

    def without_process(self) -> Method | None:
        """Return its Gaussians without the process that they are mixed with;
        None where nothing is mixed.
        """
        return None

    @property
    def stored_class(self) -> type[MethodFactory]:
        """The class that a checkpoint names."""
        return type(self)

    @property
    def fitted_site(self) -> Site:
        """The site that was learned from; `ValueError` before `fit` or `restore`."""
        return self.require_fitted(self.site)

    def require_fitted(self, part: T | None) -> T:
        """Return what a fit or a checkpoint sets; `ValueError` before."""
        if part is None:
            raise ValueError(f"{self.name}: not fitted yet; call fit or restore first")
        return part

    @abstractmethod
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Learn from `fold.train` (and choose settings on `fold.val`);
        `fold.test` is not looked at.
        """

    @abstractmethod
    def predict(self, query: Query) -> Prediction:
        """Predict what would be measured there.

        Raises:
            ValueError: before `fit` or `restore`, or the query lacks what the method reads.
        """

    def gradient_problem(self) -> str | None:
        """Return why predictions have no gradients by position; None where they have.

        Then autograd, and `torch.func.jvp` where errors of places are estimated, follow `predict`
        at float64 positions of what moves, for mean, variance and confidence, in double precision.
        What float32 positions get is not changed by it.
        """
        return self.no_gradient

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs, as weights-only unpickling accepts;
        here the attributes `stored`.
        """
        return {name: to_plain(getattr(self, name, None)) for name in self.stored}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """Become the method whose `state()` this was."""
        self.site = site
        self._relearn(state)

    def _relearn(self, state: dict[str, Any]) -> None:
        """Set what `stored` names; what cannot be stored is made again by who overrides this."""
        for name in self.stored:
            # Older checkpoints lack what has a default
            if name in state or not hasattr(type(self), name):
                setattr(self, name, from_plain(state[name]))

    def count_components(self) -> int:
        """Return the number of Gaussians, sources or stored training samples."""
        return 0

    def reduction_settings(self) -> tuple[str, ...]:
        """Return names of the settings of `reduce` that mean something to what was fitted;
        here none.
        """
        return ()

    def reduction_inputs(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Return what must be known of training rows (n,) to reduce it; stored with the model."""
        return {}

    def reduce(self, settings: Mapping[str, Any], measured: dict[str, Tensor]) -> Method:
        """Return a method that answers with these settings; this one is left as it is."""
        return self

    def station_method(self, number: int) -> Method:
        """Return what answers for a station; of a method without copies by station, itself."""
        return self

    def joint_method(self) -> HasJoint | None:
        """Return what knows how levels of stations go together; None where nothing does."""
        return None

    def objects(self) -> SiteObjects:
        """Return what it found to stand in the site."""
        return SiteObjects.from_arrays()

    def facts(self) -> dict[str, float | int | str | None]:
        """Return what `summary.json` says of a fitted model, None where it means nothing here."""
        return {
            "model/num_gaussians": self.count_components() if self.has_gaussians else None,
            "model/class": type(self).__name__,
            "model/made": self.description,
            "model/choices": None,
            "model/init": None,
            "model/steps": None,
            "model/steps_taken": None,
            "model/variance_explained": None,
            "time/init_s": None,
        }


@runtime_checkable
class Reconditions(Protocol):
    """Learns from other rows with its settings as they are:
    what is left out is forgotten but by these.
    """

    def copy_conditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """Return a method of rows (n,) alone; None where more
        than settings would remember the others.
        """
