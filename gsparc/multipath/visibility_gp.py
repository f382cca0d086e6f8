"""Visibility of sources, known at receivers by their directions of arrival and predicted elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.multipath.visibility_kernel import matern32

LENGTHS_M = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # candidates for every source
NOISES = (0.03, 0.1, 0.3, 1.0)  # candidates, in units of the process's variance


@dataclass(frozen=True)
class VisibilityGP:
    """One Gaussian process over places per source, on labels 0 and 1.

    Least-squares classification (Rasmussen and Williams 2006, section 6.5); length and noise minimise the
    leave-one-out error.

    Attributes:
        places: (n, 3) float64 [m], receivers.
        seen: (n, K) float64, 1 where a ray of the receiver points at the source.
        length: (K,) [m].
        weights: (n, K), of the deviations from the mean.
        left_out: (n, K) in [0, 1], leave-one-out predictions.
    """

    places: Tensor
    seen: Tensor
    length: Tensor
    weights: Tensor
    left_out: Tensor

    @staticmethod
    def of(places: Tensor, seen: Tensor) -> VisibilityGP:
        """From the visibility of K sources at n receivers."""
        apart, mean = torch.cdist(places, places), seen.mean(0)
        length, weights = torch.full_like(mean, LENGTHS_M[-1]), torch.zeros_like(seen)
        left_out = mean.expand_as(seen).clone()  # without a better kernel the mean
        best = (left_out - seen).square().mean(0)
        for tried in LENGTHS_M:
            values, vectors = torch.linalg.eigh(matern32((apart / tried).square()))
            turned = vectors.T @ (seen - mean)
            for noise in NOISES:
                shrunk = 1 / (values.clamp_min(0) + noise)
                alpha = vectors @ (shrunk[:, None] * turned)
                inverse = (vectors.square() * shrunk).sum(1)
                predicted = (seen - alpha / inverse[:, None]).clamp(0, 1)  # eq. 5.12
                error = (predicted - seen).square().mean(0)
                better = error < best
                best = torch.where(better, error, best)
                length[better], weights[:, better] = tried, alpha[:, better]
                left_out[:, better] = predicted[:, better]
        return VisibilityGP(places, seen, length, weights, left_out)

    def probability(self, places: Tensor) -> Tensor:
        """Probability (m, K) float64 that each source is seen from places (m, 3) [m]."""
        apart = torch.cdist(places, self.places)
        predicted = self.seen.mean(0).repeat(len(places), 1)
        for length in self.length.unique():
            of = self.length == length
            predicted[:, of] += matern32((apart / length).square()) @ self.weights[:, of]
        return predicted.clamp(0, 1)
