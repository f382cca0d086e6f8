"""A GPyTorch model as a method of gsparc: one length scale per axis, learned by gradient."""

from __future__ import annotations

import time
from typing import Any

import gpytorch
import numpy as np
import torch

from gsparc.models.baselines.gp import Components, principal_components
from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction


class _Exact(gpytorch.models.ExactGP):
    """Independent outputs (P, n) that share a Matern-5/2 kernel."""

    def __init__(self, x: torch.Tensor, y: torch.Tensor, likelihood: Any) -> None:
        super().__init__(x.expand(len(y), -1, -1), y, likelihood)
        self.mean = gpytorch.means.ZeroMean()
        self.kernel = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.MaternKernel(nu=2.5, ard_num_dims=x.shape[-1])
        )

    def forward(self, x: torch.Tensor) -> Any:
        return gpytorch.distributions.MultivariateNormal(self.mean(x), self.kernel(x))


class GPyTorch(Interpolator):
    """Exact process on the principal components of the targets.

    Args:
        components: most components.
        steps: of Adam on the marginal likelihood.
        rate: its learning rate.
    """

    name = "gpytorch"
    stored = ("x", "y", "mean", "axes", "unit", "weights")

    def __init__(self, components: int = 256, steps: int = 60, rate: float = 0.1) -> None:
        self.components, self.steps, self.rate = components, steps, rate

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        parts: Components = principal_components(targets, self.target, self.components)
        self.mean, self.axes = torch.from_numpy(parts.mean), torch.from_numpy(parts.axes)
        # One unit for all components, since they share a kernel and its scale.
        self.unit = float(parts.scores.std())
        self.x, self.y = torch.from_numpy(positions), torch.from_numpy(parts.scores.T / self.unit)
        model, began = self._model(), time.perf_counter()
        model.train()
        model.kernel.base_kernel.lengthscale = self.x.std(0) / 3
        likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        adam = torch.optim.Adam(model.parameters(), self.rate)
        for _ in range(self.steps):
            adam.zero_grad()
            loss = -likelihood(model(*model.train_inputs), model.train_targets).sum()
            loss.backward()
            adam.step()
        self.weights = {name: value.detach().clone() for name, value in model.named_parameters()}
        self._ready = model.eval()
        lengths = ", ".join(
            f"{v:.3g}" for v in model.kernel.base_kernel.lengthscale.flatten().tolist()
        )
        return (
            f"gpytorch: lengths {lengths} m along the axes, {time.perf_counter() - began:.1f} s",
        )

    def _model(self) -> _Exact:
        return _Exact(self.x, self.y, gpytorch.likelihoods.GaussianLikelihood()).double()

    def _relearn(self, state: dict[str, Any]) -> None:
        super()._relearn(state)
        self._ready = self._model().eval()
        # Bounds are infinite, and not stored
        self._ready.load_state_dict(self.weights, strict=False)

    def _look_up(self, queries: np.ndarray) -> Prediction:
        with torch.no_grad(), gpytorch.settings.fast_pred_var():
            asked = torch.from_numpy(queries).expand(len(self.y), -1, -1)
            found = self._ready(asked)
            # Of the prior's variance: 0 at measured places, 1 where nothing is known.
            scores, spread = (
                found.mean.T * self.unit,
                found.variance.mean(0) / self._ready.kernel.outputscale,
            )
        mean = self._to_targets(self.mean + scores.float() @ self.axes)
        return Prediction(mean, unknown=spread.clamp(0, 1).float())
