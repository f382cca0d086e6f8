"""Processes of real targets at fixed settings: spectra, powers, exact, given nearest rows, censored."""

from __future__ import annotations

from unittest import mock

import numpy as np
import torch
from small_worlds import LAW, fold, rows, smooth, spread, trend

from gsparc.data.own import from_arrays
from gsparc.field import kernels
from gsparc.maps import covariance
from gsparc.methods import censored_ep, gp, nearest_targets, power_kernel, power_process, vecchia
from gsparc.methods.confidence_scores import process_variance
from gsparc.methods.left_out_images import predict_left_out
from gsparc.methods.method import FitContext
from gsparc.methods.nearest_process import Values, given, weighed
from gsparc.methods.neighbourhood import Neighbourhood
from gsparc.methods.power_kernel import PowerKernel

ONE = PowerKernel((2.5,), (1.0,), 0.05, 18.0)
TWO = PowerKernel((1.2, 6.0), (0.4, 0.6), 0.08, 20.0)
PLACES, QUERIES = spread(60, 0), spread(9, 1, (13.0, 8.0, 1.0))
Arrays = dict[str, np.ndarray]


def gp_of_spectra() -> Arrays:
    """`model=gp` on spectra with length and noise as given."""
    images = (120 + 60 * smooth(PLACES, 16 * 8, 2)).clip(0, 255).astype(np.uint8).reshape(60, 8, 16)
    arrays = {"rx_position": np.zeros(3), "tx_position": PLACES, "spectrum": images}
    data = from_arrays(arrays)
    kernel = gp.Kernel(3.0, 0.02, 0.01)
    model = gp.GaussianProcess()
    with mock.patch.object(gp, "choose_kernel", lambda *unused: kernel):
        model.fit(data, fold(60, 12), FitContext())
    batch = data.batch(np.arange(48, 60))
    said = model.predict(batch.tx, batch.rx)
    parts = gp.principal_components(data.target[:48], "spectrum", 40)
    density, amplitude = gp.leave_one_out(kernel.gram(PLACES[:48]), parts.scores, 128)
    return {
        "mean": said.mean.numpy(), "variance": said.variance.numpy(), "confidence": said.confidence.numpy(),
        "density": np.array([density, amplitude]), "mean_at": model.mean_at(batch.tx, batch.rx).numpy(),
    }  # fmt: skip


def gp_of_nearest_targets() -> Arrays:
    """Targets given their nearest rows, and the density that their settings are chosen by."""
    places = spread(1200, 4, (60.0, 40.0, 1.0))
    scores = smooth(places, 5, 5).astype(np.float32)
    near = nearest_targets.NearestTargets(
        Neighbourhood.of(places, 0), torch.from_numpy(scores), PowerKernel((4.0,), (1.0,), 0.1, 0.5), 0.01
    )
    mean, variance = near.at(torch.from_numpy(spread(7, 6, (60.0, 40.0, 1.0))))
    return {"mean": mean.numpy(), "variance": variance.numpy()}


def power_process_exact() -> Arrays:
    """Two lengths about a distance law."""
    return _powers(TWO, LAW, 0)


def power_process_constant() -> Arrays:
    """One length about a constant."""
    return _powers(ONE, None, 0)


def power_process_censored() -> Arrays:
    """The same where nothing was heard in ten rows: expectation propagation."""
    return _powers(TWO, LAW, 10)


def _powers(kernel: PowerKernel, law: object, quiet: int) -> Arrays:
    told = rows(PLACES, quiet)
    process, _ = power_process.conditioned(told, trend(PLACES, law), kernel, 0)
    mean, variance, unknown = process.mean_and_variance(QUERIES)
    at = torch.from_numpy(QUERIES).requires_grad_()
    process.mean_at(at).sum().backward()
    return {
        "mean": mean, "variance": variance, "unknown": unknown, "slope": at.grad.numpy(),
        "given": process.decibels(), "covariance": covariance.posterior(process, QUERIES),
    }  # fmt: skip


def power_left_out_density() -> Arrays:
    """Leave-one-out density of powers, its amplitude and slopes."""
    found = {}
    told, about = rows(PLACES), trend(PLACES)
    distance, terms, values = power_process._views(told, about)
    for name, kernel in (("one", ONE), ("two", TWO)):
        for bounded in (False, True):
            density, amplitude, slope = power_kernel.left_out(kernel, distance, terms, values, bounded)
            found[f"{name}{bounded}"] = np.array([density, amplitude, *slope])
    return found


def censored_evidence() -> Arrays:
    """Evidence with rows below their level, and its slopes."""
    told, about = rows(PLACES, 14), trend(PLACES)
    distance, terms, values = power_process._views(told, about)
    gram = 20.0 * TWO.gram(distance, terms)
    value, slope = censored_ep.log_evidence(gram, values, told.silent)
    return {"evidence": np.array(value), "slope": slope}


def nearest_powers() -> Arrays:
    """Powers given the nearest of many rows, some of them pseudo-values of silent ones."""
    places = spread(900, 7, (300.0, 200.0, 2.0))
    told, about = rows(places, seed=3), trend(places)
    values = Values.of(np.r_[told.places, told.places[:40]], np.r_[told.decibels, told.decibels[40:80]])
    quiet = spread(20, 8, (300.0, 200.0, 2.0)) + 0.5
    silent = Values(quiet, np.full(20, -95.0), np.ones(20))
    process = given(values, about, TWO, silent, np.linspace(0.1, 2, 20), 0)
    mean, variance, unknown = process.mean_and_variance(spread(8, 9, (300.0, 200.0, 2.0)))
    left, spread_left = process.left_out()
    at = torch.from_numpy(spread(4, 10, (300.0, 200.0, 2.0))).requires_grad_()
    process.mean_at(at).sum().backward()
    about_mean, about_covariance = weighed(process.places, process.values, process.noise, about, TWO, 0)
    return {
        "mean": mean, "variance": variance, "unknown": unknown, "left_out": left,
        "left_variance": spread_left,
        "slope": at.grad.numpy(), "terms": about_mean, "terms_covariance": about_covariance,
    }  # fmt: skip


def nearest_density() -> Arrays:
    """Density of rows given their neighbours, its amplitude and slopes by settings."""
    places = torch.from_numpy(spread(40 * 9, 11)).view(40, 9, 3)
    between = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    values = torch.from_numpy(smooth(places.flatten(0, 1).numpy(), 3, 12)).view(40, 9, 3)
    count = torch.arange(360, dtype=torch.float64).view(40, 9) % 3 + 1
    found = {}
    for name, kernel, part in (("one", ONE, values[..., 0]), ("two", TWO, values)):
        sample = vecchia.Sample(
            between[:, 0, 1:], between[:, 1:, 1:], part[:, 0], part[:, 1:], count[:, 0], count[:, 1:]
        )
        at = torch.from_numpy(kernel.parameters()).requires_grad_()
        density, amplitude = vecchia._density(at, sample)
        (slope,) = torch.autograd.grad(density, at)
        found[name] = np.array([density.item(), amplitude.item(), *slope])
    return found


def left_out_beyond_gaps() -> Arrays:
    """Rows predicted without their neighbours, real and complex."""
    kernel = gp.Kernel(3.0, 0.05)
    inverse = np.linalg.inv(kernel.gram(PLACES))
    distance = np.linalg.norm(PLACES[:, None] - PLACES, axis=-1)
    values = smooth(PLACES, 6, 13)
    found = {}
    for name, part in (("real", values), ("complex", values[:, :3] + 1j * values[:, 3:])):
        mean, variance = predict_left_out(
            inverse, part, distance, np.arange(0, 60, 7), np.array([0.0, 1.0, 3.0])
        )
        found |= {f"{name}_mean": mean, f"{name}_variance": variance}
    return found


def whitened_features() -> Arrays:
    """Features whose squared length is what a process knows: all places, and some that stand for all."""
    at, values, found = torch.from_numpy(PLACES), torch.from_numpy(smooth(PLACES, 2, 14)), {}
    for name in ("matern32", "smooth_rough"):
        for most in (60, 20):
            told = kernels.whitened(at, 2.0, 0.05, name, most)
            features = kernels.correlation(torch.from_numpy(QUERIES), told.places, 2.0, name) @ told.whitening
            found |= {
                f"{name}{most}_places": told.places.numpy(),
                f"{name}{most}_known": (features @ features.T).numpy(),
                f"{name}{most}_mean": (features @ (told.weigh @ values)).numpy(),
            }
    return found


def variance_of_places() -> Arrays:
    """What places alone leave unknown of others (`gp_variance` of the confidences)."""
    return {"variance": process_variance(gp.Kernel(2.0, 0.1), PLACES, QUERIES)}
