"""The learned Gaussian field as a method: fit with Lightning, predict from a frozen plan."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.base.limits import check_arguments, or_word, switch, whole
from gsparc.data.inner_folds import cut_folds
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import GaussianCloud
from gsparc.data.splits import Fold
from gsparc.field import edit
from gsparc.field.confidence import ConfidenceSettings, fit_error_law
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import Smoothness
from gsparc.field.frozen import FrozenArray, FrozenView, freeze_view
from gsparc.field.gaussians import FieldSettings
from gsparc.field.initial import InitSettings, InitTask
from gsparc.field.losses import LossSettings, squared_error
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings, RasterSettings
from gsparc.field.optimizer import OptimizerSettings
from gsparc.field.response import ResponseSettings
from gsparc.models import checkpoint
from gsparc.models.checkpoint import StoredModel, read_interrupted
from gsparc.models.fitting import Origin
from gsparc.models.method import Method, Prediction
from gsparc.models.predicting import to_double
from gsparc.models.splat import reduce
from gsparc.models.splat.auto_settings import Choices, apply_choices, resolve_auto
from gsparc.models.splat.closed_form_start import start_in_closed_form
from gsparc.models.splat.left_out_images import LeftOut
from gsparc.models.stack import LEAST_HELD
from gsparc.ops import Pose
from gsparc.processes.stored import from_plain, to_plain
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort
from gsparc.training.stopwatch import Stopwatch

if TYPE_CHECKING:
    from gsparc.field.gradient_stage import TrainerResult

log = logging.getLogger(__name__)

THIRDS = 3  # of the rows: one is for validation where few were set apart
LEAST_TOLD = 8  # validation rows: fewer say by chance which steps and which mixtures pay
# Times the antennas of an array: so many Gaussians give it any vector, and more the same
ENOUGH = 2
STEP_COUNTS = ("trainer.max_steps", "trainer.max_epochs")  # which ask for no step, too
QUERY_CHUNK = 256  # bounds the memory of one prediction call


@dataclass(frozen=True)
class Stage:
    """A part of a fit that begins with a fresh model, or goes on with one.

    Attributes:
        name: `train`; `refit`: as many steps again on all rows; `final`: the start alone, on all
            rows.
        fold: whose training rows it learns from.
        context: the fit's, with the stage's folder and the file that it resumes from.
        steps: of gradient, of its schedule.
        watched: whether steps end early that do not pay, see `KeepBest`.
    """

    name: Literal["train", "refit", "final"]
    fold: Fold
    context: FitContext
    steps: int
    watched: bool = False

    @property
    def cost_suffix(self) -> str:
        """What is added to the names of its costs."""
        return "" if self.name == "train" else " again, on all rows"


class LearnedField(Method):
    """A Gaussian field trained by gradient, with no process beside it (`model=splat`).

    Args:
        field, emission, attenuation, raster, confidence: all switches of the model.
        loss: task loss.
        optimizer: learning rates.
        response: coherent terms: an array's spectra.
        name: as it appears in tables.
        init: where Gaussians come from; `auto` solves the emission in closed form where it can.
        refit: after validation, train again on training and validation rows together.
        keep_best: end with the parameters of the best look at validation rows, the start among
            them.
        steps: of gradient, where `trainer.max_steps` and `trainer.max_epochs` give none; `auto`: 60
            after a start in closed form, else 400, fewer where the first looks show no gain
            (`KeepBest`). 0 of either is the start alone.
        guesses: settings the source of this configuration does not give, one line each.
    """

    effects = "image"
    has_gaussians = True
    resumable = True  # every step's state is in `last.ckpt`
    takes_effort = takes_weights = True
    # Whether a process beside it has all the weight: another stage gains nothing
    _is_process_alone = False
    _ended: tuple[str, ...] = ()
    # The float64 copy of a version of the model, for an array or not.
    _doubled: tuple[tuple[int, bool], tuple[GaussianModel, FrozenArray | None]] | None = None

    def __init__(
        self,
        field: FieldSettings = FieldSettings(),
        emission: EmissionSettings = EmissionSettings(),
        attenuation: AttenuationSettings = AttenuationSettings(),
        raster: RasterSettings = RasterSettings(),
        confidence: ConfidenceSettings = ConfidenceSettings(),
        loss: LossSettings = LossSettings(),
        optimizer: OptimizerSettings = OptimizerSettings(),
        response: ResponseSettings = ResponseSettings(),
        name: str = "splat",
        init: InitSettings | None = None,
        refit: bool = True,
        keep_best: bool = True,
        steps: int | Literal["auto"] = "auto",
        guesses: Sequence[str] = (),
    ) -> None:
        check_arguments(
            locals(), refit=switch(), keep_best=switch(), steps=or_word(whole(0), "auto")
        )
        self.settings = ModelSettings(field, emission, attenuation, raster, response, confidence)
        self.loss, self.rates, self.name = loss, optimizer, name
        self.init = replace(init or InitSettings(), snapshot=loss.snapshot)
        # A guess about a callback that is left out reads None (oc.select).
        self.refit, self.guesses = refit, tuple(guess for guess in guesses if " None" not in guess)
        self.keep_best, self.most_steps = keep_best, None if steps == "auto" else steps
        if not field.count:  # then no step changes anything
            self.most_steps = 0
        self.model: GaussianModel | None = None
        self.site: Site | None = None
        self.choices: Choices | None = None
        self._ends: dict[str, Tensor] = {}
        # (A, K); a file may not say where its antennas are
        self._shape: tuple[int, int] | None = None
        self._prior: Smoothness | None = None
        self._paying: int | None = None  # position in the schedule after which steps did not pay
        # Of gradient: kept in the last stage, and taken in the first
        self.steps = self.steps_taken = 0
        self.init_s: float | None = None  # of all initialisers; None of a model read back
        self._earlier_s = 0.0  # of training, by the stages so far [s]
        self.frozen: FrozenView | FrozenArray | None = None
        self.spent: dict[str, float] = {}  # of each stage of the last fit [s]
        self._left_out: LeftOut | None = None  # of the initialiser; not stored
        # Validation rows from the nearest training row, median [m]
        self._apart: float | None = None

    # -- learning ----------------------------------------------------------------------------------

    def settings_read(self) -> frozenset[str]:
        """See `Method.settings_read`; without a step, the Trainer's is their number alone."""
        steps = ("trainer", "callbacks", "dataset.batch_size") if self.steps_taken else STEP_COUNTS
        return super().settings_read() | {*steps}

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train on `fold.train`; `fold.val` is watched, calibrates the confidence,
        and is then learned too.

        A start in closed form is step 0, with the same looks at validation rows as every later
        step. Where it stays the best, it is solved again on all rows, and that is the result. Where
        steps are kept, a second stage (`refit`) takes as many on training and validation rows
        together, because the baselines learn from all of them, with the confidence of the first.
        """
        # Here, as Lightning takes two seconds to import, and answers need none of it.
        from lightning.pytorch import seed_everything

        from gsparc.models.gradient import take_steps

        origin = Origin.from_fit(data, fold, context)
        stored_model = None if context.resume is None else read_interrupted(context.resume)
        if stored_model is not None:
            origin.require_same(stored_model)
        marks = {} if stored_model is None else stored_model.extra
        watch = Stopwatch(*(float(marks.get(name, 0.0)) for name in ("spent_s", "spent_cpu_s")))
        self._begin_fit(data, fold, marks)
        for stage in self._plan_stages(data, fold, context, stored_model):
            seed_everything(stage.context.seed, verbose=False)
            if not self._start_stage(stage, data, watch):
                continue
            began, marks = watch.seconds, self._extra(stage, watch, origin)
            result = take_steps(self, stage, data, watch, marks)
            self._end_stage(stage, result, watch.seconds - began)
        self.frozen = self._doubled = None
        label, count = (
            (f"final, {self.steps} of {self.steps_taken} steps kept"),
            self.count_components(),
        )
        context.log_curve(watch.seconds, label, step=self.steps_taken, num_gaussians=count)
        return FitReport(watch.seconds, self._ended, cpu_s=watch.cpu_elsewhere)

    def describe_fit(self, data: Measurements, effort: Effort, steps: int | None = None) -> str:
        """See `MethodFactory`."""
        self._refuse_site(data.site)
        choices, _ = resolve_auto(self.settings, self.init.name, data.site)
        count = self.most_steps if steps is None else steps
        if choices.closed_form:
            usual = f"at most {effort.steps_after_solving}"
            return f"closed form, then {usual if count is None else count} gradient steps"
        return f"{effort.steps if count is None else count} gradient steps from init={choices.init}"

    def _refuse_site(self, site: Site) -> None:
        """Raise `ValueError`, one line, where it has no such field."""
        one_end = not (site.target.is_level or site.paired)
        if self.settings.response.channel != "mean" or one_end:
            return
        why = "the target is powers" if site.target.is_level else "both ends move"
        raise ValueError(
            f"{self.name}: the paper's field is of spectra and channels between an end that "
            "stands and one "
            f"that moves; here {why}: take model=gsparc without paper="
        )

    def _begin_fit(self, data: Measurements, fold: Fold, extra: Mapping[str, Any]) -> None:
        """Look at the site, and take what an interrupted run has marked; {} of a new one.

        Raises:
            ValueError: it has no such field.
        """
        self._refuse_site(data.site)
        self.site, self._ends = data.site, _static_end_position(data, int(fold.train[0]))
        if data.site.target.is_complex:
            if np.isnan([data.tx, data.rx_position]).any():
                fault = f"{data.site.name} does not say where its static end is"
                raise ValueError(f"{self.name}: {fault}; take model=complex_gp")
            self._shape = (data.target.shape[1], data.target.shape[2])
        self.choices, reasons = resolve_auto(self.settings, self.init.name, data.site)
        for reason in reasons:
            log.info("%s", reason)
        if data.site.target.is_complex and self.choices.activation == "sigmoid":
            log.warning(
                "%s: a sigmoid is positive, so that real and imaginary parts of these channels "
                "cannot be "
                "negative; model.emission.activation=signed_sigmoid is the smallest change that "
                "can be",
                self.name,
            )
        self._paying, self.init_s = extra.get("paying"), float(extra.get("init_s", 0.0))
        self.steps_taken, self._earlier_s = (
            int(extra.get("taken", 0)),
            float(extra.get("earlier_s", 0.0)),
        )
        self.spent, self._apart = {}, _validation_distance(data, fold)
        # An interrupted run's start is not repeated
        self._left_out = from_plain(extra.get("left_out"))
        self._ended = tuple(extra.get("ended", ()))

    def _plan_stages(
        self, data: Measurements, fold: Fold, context: FitContext, resumed: StoredModel | None
    ) -> Iterator[Stage]:
        """Yield the stages in order; the results of earlier ones decide what follows.

        Args:
            resumed: by an interrupted run.
        """
        assert self.choices is not None
        solved, few = self.choices.closed_form, self.keep_best and len(fold.val) < LEAST_TOLD
        watched = _hold_out_third(data, fold, context) if few else fold
        step_count = context.requested_steps(len(watched.train), self.most_steps)
        usual = context.counts.steps_after_solving if solved else context.counts.steps
        steps = usual if step_count is None else step_count
        log.info(
            "steps=%s%d: a start %s",
            "auto -> " if step_count is None else "",
            steps,
            "in closed form" if solved else f"from init={self.choices.init}",
        )
        refits = resumed is not None and resumed.extra.get("stage") == "refit"
        if resumed is not None and refits:
            self.restore(data.site, resumed.state)
        else:
            watching = not self.keep_best or len(watched.val) > 0 or not solved
            if steps and watching:
                # Steps that somebody asks for are all taken.
                yield Stage("train", watched, context, steps, step_count is None)
            if solved and (few or not watching):
                self._paying = 0  # by so few rows steps would be chosen by chance
            if solved and (self._paying == 0 or not steps):
                # No step was surely better, or none was asked for: the start,
                # solved again on all rows.
                self.steps, last_fold = 0, _train_on_all(fold) if self.refit else fold
                yield Stage("final", last_fold, replace(context, resume=None), 0)
                self._weigh_process(data, last_fold)
                return
            if not steps:
                yield Stage("train", watched, context, 0)
            self._calibrate_errors(data, watched)
            self._weigh_process(data, watched)
        if self.refit and len(watched.val) and not self._is_process_alone:
            resume = context.resume if refits else None
            yield Stage(
                "refit", _train_on_all(watched), context.for_part("refit", resume=resume), steps
            )

    def _start_stage(self, stage: Stage, data: Measurements, watch: Stopwatch) -> bool:
        """Make a fresh model, or read one back; return whether steps are taken.

        `refit` keeps the confidence of the stage before:
        the rows that calibrated it are learned from now.
        """
        context, folder = stage.context, stage.context.run_dir
        started, before = watch.seconds, self.model
        assert self.choices is not None
        if context.init_from is not None and context.resume is None:
            self._start_from(data.site, context.init_from)
        elif context.resume is None:
            start = start_in_closed_form(
                InitTask(
                    apply_choices(self.settings, self.choices),
                    self.choices.closed_form,
                    data,
                    stage.fold.train,
                    self._static_receiver(),
                    self._ends.get("tx_position"),
                    context.seed,
                    folder,
                    watch,
                )
            )
            self._prior = start.prior
            self.model = self._new_model(data.site)
            solved = None if start.solve is None else start.solve(self.model)
            self._left_out = solved or start.left_out
        else:
            self.restore(data.site, checkpoint.read(context.resume).state)
        if stage.name == "refit":
            assert before is not None
            self.fitted_model().confidence, self.fitted_model().error = (
                before.confidence,
                before.error,
            )
            if before.confidence is not None:
                before.confidence.requires_grad_(False)
        prepared = watch.seconds - started
        self.init_s, self._earlier_s = (self.init_s or 0.0) + prepared, self._earlier_s + prepared
        self.spent["initialiser" + stage.cost_suffix] = prepared
        if stage.steps and self._paying == 0:
            self.steps = 0
        return stage.steps > 0 and self._paying != 0

    def _extra(self, stage: Stage, watch: Stopwatch, origin: Origin) -> dict[str, Any]:
        """What `_begin_fit` reads of a run that is interrupted in a stage."""
        return {
            "stage": stage.name,
            "earlier_s": self._earlier_s,
            "spent_s": watch.seconds,
            "spent_cpu_s": watch.cpu_seconds,
            "ended": [*self._ended],
            "paying": self._paying,
            "init_s": self.init_s,
            "taken": self.steps_taken,
            "left_out": to_plain(self._left_out),
            **origin.to_extra(),
        }

    def _end_stage(self, stage: Stage, result: TrainerResult, seconds: float) -> None:
        """Note what the steps of a stage were worth."""
        self._earlier_s += seconds
        self.steps = result.taken if result.kept is None else result.kept
        self.spent["gradient steps" + stage.cost_suffix] = seconds
        self._ended += result.notes
        if stage.name == "train":
            self._paying, self.steps_taken = result.kept, result.taken

    def _weigh_process(self, data: Measurements, fold: Fold) -> None:
        """A hook between the stages: what a process averaged with the field would gain."""

    def _start_from(self, site: Site, path: Path) -> None:
        """Take the weights of another model of this site; what is learned anew are these rows.

        Raises:
            ValueError: it holds no Gaussian field, or one of other positions, directions or
                channels.
        """
        stored = checkpoint.read(path)
        state = stored.state.get("inner", stored.state)
        if "model" not in state:
            raise ValueError(f"init_from={path}: {stored.method} holds no Gaussian field")
        for name in ("kind", "grid", "static_end"):
            if getattr(site, name) != getattr(stored.site, name):
                raise ValueError(
                    f"init_from={path}: its {name} is another; take a model of the same {name}"
                )
        if not np.allclose(site.origin, stored.site.origin, atol=1e-6):
            raise ValueError(
                f"init_from={path}: its origin is {stored.site.origin} m, here it is "
                f"{site.origin} m"
            )
        LearnedField.restore(self, site, {**state, "ends": self._ends, "shape": self._shape})

    def _static_receiver(self) -> Pose | None:
        ends = self._ends
        return Pose(ends["rx_position"], ends["rx_rotation"]) if "rx_position" in ends else None

    def _new_model(self, site: Site) -> GaussianModel:
        assert self.choices is not None
        settings, transmitter = (
            apply_choices(self.settings, self.choices),
            self._ends.get("tx_position"),
        )
        return GaussianModel(
            settings, site, self._static_receiver(), transmitter, self._prior, self._shape
        )

    @torch.no_grad()
    def _calibrate_errors(self, data: Measurements, fold: Fold) -> None:
        """Fit what tells errors on validation rows, which steps did not learn from."""
        model = self.fitted_model()
        rows = fold.val if len(fold.val) else fold.train
        if model.confidence is not None:
            model.confidence.store_range(
                torch.from_numpy(np.asarray(data.moving[rows], dtype=np.float32))
            )
        if model.error is not None and len(fold.val) >= LEAST_HELD:
            batch = data.batch(fold.val)
            result = model(batch.tx, batch.rx)
            assert result.unknown is not None
            error = squared_error(result.mean.clamp(0, 1), batch, model.site.target)
            model.error.set_error_law(
                *fit_error_law(result.unknown.numpy(), error.double().numpy())
            )

    # -- answering ---------------------------------------------------------------------------------

    def fitted_model(self) -> GaussianModel:
        """Return the trained model.

        Raises:
            ValueError: before `fit` or `restore`.
        """
        return self.require_fitted(self.model)

    @property
    def threads_pay(self) -> bool:  # type: ignore[override]
        """See `Method`; through an array all pixels follow from a few numbers."""
        return not self.settings.response.array

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return Prediction.joined(
            [self._predict_at(part.tx, part.rx) for part in query.split(QUERY_CHUNK)]
        )

    def _predict_at(self, tx: Tensor, rx: Pose) -> Prediction:
        if tx.dtype == torch.float64:
            return self._render_prediction(*self._in_float64(rx.to(torch.float32)), tx, rx)
        with torch.no_grad():
            return self._render_prediction(self.fitted_model(), self.frozen_at(rx), tx, rx)

    def gradient_problem(self) -> str | None:
        """Return a reason where the receiver moves: footprints that move have no gradient."""
        if self.site is not None and self.site.moving_end == "rx":
            return "footprints of Gaussians have none by the receiver's position"
        return None

    @torch.no_grad()
    def _in_float64(self, rx: Pose) -> tuple[GaussianModel, FrozenArray | None]:
        """The model and what an array sees of it, in float64; images are rendered:
        these have gradients.
        """
        model, seen = (
            self.fitted_model(),
            self.frozen_at(rx) if self.settings.response.array else None,
        )
        frozen = seen if isinstance(seen, FrozenArray) else None
        of = int(model.gaussians.version), frozen is None
        if self._doubled is None or self._doubled[0] != of:
            self._doubled = of, to_double((model, frozen))
        return self._doubled[1]

    def _render_prediction(
        self, model: GaussianModel, frozen: FrozenView | FrozenArray | None, tx: Tensor, rx: Pose
    ) -> Prediction:
        result = model(tx, rx) if frozen is None else frozen.render(model, tx, rx)
        mean = result.mean
        if model.site.target.is_image:
            mean = mean.clamp(0, 1) if mean.dtype == torch.float64 else mean.clamp_(0, 1)
        if model.error is not None and result.unknown is not None:
            return Prediction(mean, *model.error(result.unknown))
        if model.confidence is None:
            return Prediction(mean)
        return Prediction(
            mean, unknown=1 - model.confidence.normalised_confidence(model.site.moving(tx, rx))
        )

    def frozen_at(self, rx: Pose) -> FrozenView | FrozenArray | None:
        """Return the matrix of the static receiver, made anew after an edit;
        None for any other pose.
        """
        model, static = self.fitted_model(), self._static_receiver()
        if not model.site.target.is_image or static is None or rx.batched:
            return None
        if not (
            torch.equal(rx.position, static.position) and torch.equal(rx.rotation, static.rotation)
        ):
            return None
        if self.frozen is None or self.frozen.version != int(model.gaussians.version):
            self.frozen = freeze_view(model, rx)
        return self.frozen

    @torch.no_grad()
    def gaussians(self, query: Query) -> GaussianCloud:
        """See `HasGaussians`; their attenuated emissions."""
        if self.model is None or not self.count_components():
            raise ValueError(f"{self.name}: nothing here is rendered from Gaussians")
        model, square = self.model, torch.zeros(self.count_components())
        for row in query.split(1):  # features of all would be gigabytes
            square += model.emissions(row.tx, row.rx)[0].square().sum(1)
        return model.gaussians.to_cloud(
            (square / max(len(query), 1)).sqrt(), "emission of a Gaussian"
        )

    # -- what it can do besides --------------------------------------------------------------------

    reduction_settings = reduce.reduction_settings
    reduction_inputs = reduce.reduction_inputs
    reduce = reduce.reduce_field

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return everything `restore` needs."""
        prior = None if self._prior is None else vars(self._prior)
        choices = None if self.choices is None else vars(self.choices)
        model = self.fitted_model().state_dict()
        return {
            "choices": choices,
            "ends": self._ends,
            "prior": prior,
            "shape": self._shape,
            "model": model,
            "steps": (self.steps, self.steps_taken),
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """Become the field whose `state()` this was."""
        self.site = site
        self.choices = Choices(**state["choices"])
        self.steps, self.steps_taken = state.get("steps", (0, 0))
        self._ends = dict(state["ends"])
        self._shape = None if state["shape"] is None else tuple(state["shape"])
        self._prior = None if state["prior"] is None else Smoothness(**state["prior"])
        self.model = self._new_model(site)
        edit.resize_gaussians(
            self.model, self.model.gaussians, len(state["model"]["gaussians.ids"])
        )
        self.model.load_state_dict(state["model"])
        self.frozen = self._doubled = None

    def count_components(self) -> int:
        """Return the number of Gaussians."""
        return len(self.fitted_model().gaussians)

    @property
    def description(self) -> str:
        """See `Method`."""
        if self.choices is None or self.model is None:
            return self.label
        hidden, count = self.settings.emission.hidden, len(self.model.gaussians)
        kind = "array process" if self.settings.response.array else "process of images"
        text = (
            (f"networks of {hidden} hidden units in {count} Gaussians")
            if hidden
            else f"{count} Gaussians"
        )
        text = f"{kind} through {text}" if self.choices.closed_form else text
        if self.choices.init == "vectors" and not self.steps and self.site is not None:
            enough = ENOUGH * len(self.site.array_geometry()[0])
            if count >= enough:
                text += f" ({enough} or more give the same answers)"
        part = "all" if self.steps == self.steps_taken else self.steps or "none"
        return text + (
            f", {self.steps_taken} gradient steps, {part} kept"
            if self.steps_taken
            else ", no gradient steps"
        )

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        facts = super().facts()
        if self.choices is not None:
            chosen = {"init": self.choices.init, "encoding": self.choices.encoding}
            chosen |= {"activation": self.choices.activation, "steps": str(self.steps_taken)}
            facts |= {
                "model/choices": ", ".join(f"{name}={value}" for name, value in chosen.items())
            }
            facts |= {"model/init": self.choices.init}
        return facts | {
            "model/steps": self.steps,
            "model/steps_taken": self.steps_taken,
            "time/init_s": self.init_s,
        }


def _train_on_all(fold: Fold) -> Fold:
    """Training and validation rows as training rows."""
    return Fold(np.sort(fold.learned()), fold.val[:0], fold.test)


def _hold_out_third(data: Measurements, fold: Fold, context: FitContext) -> Fold:
    """With a third of the rows for validation, cut as the test is;
    all are learned from in the end.
    """
    fit_rows = np.sort(fold.learned())
    if len(fit_rows) < THIRDS * LEAST_HELD:
        return fold
    cut = cut_folds(data, fold, context.split, THIRDS, context.seed).folds[0]
    return Fold(np.setdiff1d(fit_rows, cut.test), cut.test, fold.test)


def _validation_distance(data: Measurements, fold: Fold) -> float | None:
    """How far validation rows are from the nearest training row, median [m];
    None where there are none.
    """
    if not len(fold.val):
        return None
    return float(np.median(cKDTree(data.moving[fold.train]).query(data.moving[fold.val])[0]))


def _static_end_position(data: Measurements, row: int) -> dict[str, Tensor]:
    """Where the end that never moves stands, local coordinates [m]."""
    row_query = data.batch(np.array([row]))
    if data.site.static_end == "rx":
        return {"rx_position": row_query.rx.position, "rx_rotation": row_query.rx.rotation}
    return {"tx_position": row_query.tx[0]}
