"""Adaptive density: clone small, split large, prune useless Gaussians (paper, algorithm 1)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import lightning.pytorch as L
import torch
from torch import Tensor

from gsparc.base.limits import POSITIVE, Checked, number, or_null, setting, whole
from gsparc.field import edit
from gsparc.field.distributed import process_max, process_sum
from gsparc.field.model import GaussianModel
from gsparc.field.readout import solve_readout
from gsparc.field.schedule import INTERVAL, STEPS, acts_at_step, to_steps
from gsparc.training.tracking import log_event

log = logging.getLogger(__name__)

LEAST = 1e-7  # of an opacity, and of what lacks it to 1: logits of both are finite in float32
# Root mean square, that an edit may make of spectra whose emissions were solved for
MOST_CHANGE = 1e-3


@dataclass(eq=False)
class Densify(Checked, L.Callback):
    """Clone, split and prune on a schedule of steps.

    >>> Densify(start=0.1, stop=0.6, interval=50, max_gaussians=2_000).children
    2
    >>> Densify(children=1)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: children=1: a whole number of at least 2 is needed

    Args:
        start, stop, interval: first step, last step and spacing of the edits; below 1 a share of
            all steps.
        grad_threshold: mean screen-space gradient norm [loss per px] above which a Gaussian is
            under-reconstructed; read per sample before summing.
        size_share: Gaussians up to this share of the scene radius are cloned, larger ones split.
        children: number N of children of a split; their scale is the parent's / (`shrink` N).
        shrink: see `children`.
        min_opacity: prune below this opacity.
        max_radius: prune above this footprint radius [px], from step `radius_from` on; null never
            does.
        radius_from: first step that prunes by radius, or its share of all steps.
        max_size_share: prune where the largest standard deviation is above this share of the
            scene's diagonal; null never does.
        max_gaussians: never more than this many.
        min_gaussians: pruning stops at this many, the most opaque stay.
        part: what tells it from others of one training; "" of the only one.
    """

    edits_gaussians: ClassVar = True
    start: int | float = setting(500, STEPS)
    stop: int | float = setting(15_000, STEPS)
    interval: int | float = setting(100, INTERVAL)
    grad_threshold: float = setting(2e-4, number(0))
    size_share: float = setting(0.01, number(0))
    children: int = setting(2, whole(2))
    shrink: float = setting(0.8, POSITIVE)
    min_opacity: float = 0.005
    max_radius: float | None = setting(None, or_null(POSITIVE))
    radius_from: int | float = setting(0, STEPS)
    max_size_share: float | None = setting(None, or_null(POSITIVE))
    max_gaussians: int = setting(100_000, whole(1))
    min_gaussians: int = setting(16, whole(0))
    part: str = ""
    statistics: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)
    # An edit would have changed what is rendered
    _ended: bool = field(default=False, init=False, repr=False)
    # The last edit had more to add than room
    _is_full: bool = field(default=False, init=False, repr=False)
    _full_is_logged: bool = field(default=False, init=False, repr=False)

    @property
    def state_key(self) -> str:
        """What its state is stored under."""
        return " ".join(filter(None, (type(self).__qualname__, self.part)))

    def _zero_statistics(self, model: GaussianModel) -> dict[str, Tensor]:
        count = len(model.gaussians)
        device = model.gaussians.means.device
        return {key: torch.zeros(count, device=device) for key in ("gradient", "seen", "radius")}

    def on_after_backward(self, trainer: L.Trainer, module: Any) -> None:
        """Accumulate positional gradients and radii of the Gaussians that were seen."""
        if module.rendered is None or module.global_step >= to_steps(self.stop, module.total_steps):
            return
        raster = module.rendered.raster or module.model.raster_of_weights(
            module.rendered, module.batch.rx
        )
        if raster is None:
            return
        if not self.statistics or len(self.statistics["seen"]) != len(module.model.gaussians):
            self.statistics = self._zero_statistics(module.model)
        gradient = raster.means2d.grad
        if gradient is None:
            return
        with torch.no_grad():
            visible = raster.visible.float()
            if module.batch.rx.batched:
                if not module.batch.share:  # another process has these rows
                    visible = torch.zeros_like(visible)
                sums = torch.stack([(gradient.norm(dim=-1) * visible).sum(0), visible.sum(0)])
                result, seen = process_sum(sums)
            else:  # of one pose the gradient is the sum over rows, and every process sees the same
                result, seen = (
                    (process_sum(gradient.clone()).norm(dim=-1) * visible).sum(0),
                    visible.sum(0),
                )
            self.statistics["gradient"] += result
            self.statistics["seen"] += seen
            radius = (raster.radii * visible).amax(0) if len(visible) else self.statistics["radius"]
            self.statistics["radius"] = process_max(
                torch.maximum(self.statistics["radius"], radius.float())
            )

    def on_train_batch_start(
        self, trainer: L.Trainer, module: Any, batch: Any = None, *unused: Any
    ) -> None:
        """Edit the field when the schedule says so, after the validation of the step before."""
        if not self.statistics or self._ended:
            return
        step = module.global_step
        if not acts_at_step(step, self.start, self.stop, self.interval, module.total_steps):
            return
        model: GaussianModel = module.model
        with torch.no_grad():
            # Draws are a pure function of (seed, step): a resumed run makes the same children.
            draws = torch.Generator().manual_seed(torch.initial_seed() + step)
            by_radius = step >= to_steps(self.radius_from, module.total_steps)
            planned = self.plan(model, draws, in_place=module.solved, by_radius=by_radius)
            before = len(model.gaussians)
            solved = solve_readout(model, planned, batch) if module.solved else None
            change = 0.0 if solved is None else float(process_sum(solved.change)) ** 0.5
            if change > MOST_CHANGE:
                text = (
                    "step %d: no Gaussians added from here on: spectra would change by %.1e, "
                    "more than %g"
                )
                log.info(text, step, change, MOST_CHANGE)
                self._ended = True
                return
            edit.apply_edit(planned, model, model.gaussians, trainer.optimizers[0])
            if solved is not None:
                model.emission.weight2.copy_(solved.weight)
                model.emission.bias2.copy_(solved.bias)
            self.statistics = self._zero_statistics(model)
        _log_edit(trainer, module, planned, before, step)
        if self._is_full and not self._full_is_logged:
            text = "no room for more Gaussians since step %d: callbacks.densify.max_gaussians=%d"
            log.warning(text, step, self.max_gaussians)
            self._full_is_logged = True

    def plan(
        self,
        model: GaussianModel,
        generator: torch.Generator,
        in_place: bool = False,
        by_radius: bool = True,
    ) -> edit.Edit:
        """Decide what to clone, split and prune from the statistics gathered so far.

        Args:
            model: the field.
            generator: of the places of children.
            in_place: children stay where the parent was, as large, and let through together what it
                did, so that the field renders as before: for emissions that were solved for it.
            by_radius: whether large footprints are removed.
        """
        gaussians = model.gaussians
        # Over the rows that saw it: a sum would grow with how often a Gaussian is in view.
        mean_gradient = self.statistics["gradient"] / self.statistics["seen"].clamp_min(1)
        under_reconstructed = mean_gradient >= self.grad_threshold
        size = gaussians.scales.amax(1)
        scene_radius = float((torch.as_tensor(model.site.box[1] - model.site.box[0])).norm() / 2)
        large = size > self.size_share * scene_radius

        prune = gaussians.opacities < self.min_opacity
        if self.max_radius is not None and by_radius:
            prune |= self.statistics["radius"] > self.max_radius
        if self.max_size_share is not None:
            prune |= size > self.max_size_share * 2 * scene_radius
        prune = self._limit_pruning(prune, gaussians.opacities)

        room = max(self.max_gaussians - int((~prune).sum()), 0)
        # A split removes its parent, a clone leaves it there.
        cost = torch.where(large | in_place, self.children - 1, 1)
        wanted = under_reconstructed & ~prune
        chosen = self._choose_within_room(wanted, mean_gradient, cost, room)
        self._is_full = bool((wanted & ~chosen).any())
        clone, split = (
            (chosen & ~large, chosen & large) if not in_place else (chosen & False, chosen)
        )
        clones = clone.nonzero().squeeze(1)
        splits = split.nonzero().squeeze(1).repeat_interleave(self.children)
        parents = torch.cat([clones, splits])
        if in_place:
            # N layers of opacity b let through (1 - b)^N, which is to be 1 - a of the parent.
            opacities = -torch.expm1(torch.log1p(-gaussians.opacities[splits]) / self.children)
            return edit.Edit(
                ~(prune | split),
                parents,
                {"gaussians.opacity_logits": torch.logit(opacities, LEAST)},
            )
        # Two children are 1 / 1.6 of their parent, as in B. Kerbl et al.,
        # 3D Gaussian splatting (2023).
        smaller = gaussians.log_scales[splits] - math.log(self.shrink * self.children)
        scales = torch.cat([gaussians.log_scales[clones], smaller])
        spread = _sample_inside(gaussians.scales[splits], gaussians.quats[splits], generator)
        means = torch.cat([gaussians.means[clones], gaussians.means[splits] + spread])
        moved = {"gaussians.means": means, "gaussians.log_scales": scales}
        return edit.Edit(~(prune | split), parents, moved)

    def _limit_pruning(self, prune: Tensor, opacities: Tensor) -> Tensor:
        short = min(self.min_gaussians, len(prune)) - int((~prune).sum())
        if short > 0:
            # Of those that were to go, the most opaque stay.
            candidates = torch.where(prune, opacities, -torch.ones_like(opacities))
            prune = prune.clone()
            prune[candidates.topk(short).indices] = False
        return prune

    @staticmethod
    def _choose_within_room(
        under_reconstructed: Tensor, gradient: Tensor, cost: Tensor, room: int
    ) -> Tensor:
        rank = torch.where(under_reconstructed, gradient, -torch.ones_like(gradient))
        # Stable: where gradients are equal, a resumed run chooses the same.
        order = rank.argsort(descending=True, stable=True)
        spent = torch.where(under_reconstructed, cost, 0)[order].cumsum(0)
        chosen = torch.zeros_like(under_reconstructed)
        chosen[order] = under_reconstructed[order] & (spent <= room)
        return chosen

    def state_dict(self) -> dict[str, Any]:
        """Return statistics gathered since the last edit."""
        return {"statistics": dict(self.statistics), "ended": self._ended}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue in the middle of an interval."""
        self.statistics, self._ended = dict(state["statistics"]), bool(state["ended"])


def _log_edit(trainer: L.Trainer, module: Any, planned: edit.Edit, before: int, step: int) -> None:
    """A line in the log and figures for the trackers, where anything was changed."""
    after, gone = len(module.model.gaussians), int((~planned.keep).sum())
    if gone or len(planned.parents):
        log.info(
            "step %d: %d Gaussians removed or split, %d added: %d -> %d",
            step,
            gone,
            len(planned.parents),
            before,
            after,
        )
        log_event(trainer, module, {"densify/removed": gone, "densify/added": len(planned.parents)})


def _sample_inside(scales: Tensor, quats: Tensor, generator: torch.Generator) -> Tensor:
    """Offsets (M, 3) [m] drawn from Gaussians with the given scales (M, 3) and rotations (M, 4)."""
    w, *v = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axis = torch.stack(v, -1)
    local = torch.randn(scales.shape, generator=generator).to(scales) * scales
    # Rotating by a unit quaternion: x + 2 w (v x x) + 2 v x (v x x).
    turned = torch.linalg.cross(axis, local)
    return local + 2 * w.unsqueeze(-1) * turned + 2 * torch.linalg.cross(axis, turned)
