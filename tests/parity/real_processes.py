"""Processes of real targets at fixed settings: spectra, powers, exact, given nearest rows, censored."""

from __future__ import annotations

from unittest import mock

import numpy as np
import torch
from small_worlds import LAW, fold, rows, smooth, spread, trend

from gsparc.data.own import from_arrays
from gsparc.models.baselines import gp
from gsparc.models.left_out_images import predict_left_out
from gsparc.models.powers import settings as power_settings
from gsparc.prediction.confidence import process_variance
from gsparc.processes import censored, density, features, nearest, powers
from gsparc.processes.kernel import Kernel
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Law
from gsparc.training.context import FitContext

ONE = Kernel((2.5,), (1.0,), 0.05, 18.0)
TWO = Kernel((1.2, 6.0), (0.4, 0.6), 0.08, 20.0)
PLACES, QUERIES = spread(60, 0), spread(9, 1, (13.0, 8.0, 1.0))
Arrays = dict[str, np.ndarray]


def gp_of_spectra() -> Arrays:
    """`model=gp` on spectra with length and noise as given."""
    images = (120 + 60 * smooth(PLACES, 16 * 8, 2)).clip(0, 255).astype(np.uint8).reshape(60, 8, 16)
    arrays = {"rx_position": np.zeros(3), "tx_position": PLACES, "spectrum": images}
    data = from_arrays(arrays)
    kernel = Kernel.of_one(3.0, 0.02, 0.01)
    model = gp.GaussianProcess()
    with mock.patch.object(gp, "choose_kernel", lambda *unused: kernel):
        model.fit(data, fold(60, 12), FitContext())
    batch = data.batch(np.arange(48, 60))
    said = model.predict(batch.tx, batch.rx)
    parts = gp.principal_components(data.target[:48], "spectrum", 40)
    gram, scores = kernel.gram(torch.from_numpy(PLACES[:48])), torch.from_numpy(parts.scores)
    nats, amplitude = density.LeftOutDensity.apply(gram, scores, 128, False)
    per_number = float(nats) / 48 - 0.5 * np.log(2 * np.pi * np.e)
    return {
        "mean": said.mean.numpy(), "variance": said.variance.numpy(), "confidence": said.confidence.numpy(),
        "density": np.array([per_number, float(amplitude)]),
        "mean_at": model.mean_at(batch.tx, batch.rx).numpy(),
    }  # fmt: skip


def gp_of_nearest_targets() -> Arrays:
    """Targets given their nearest rows, and the density that their settings are chosen by."""
    places = spread(1200, 4, (60.0, 40.0, 1.0))
    scores = smooth(places, 5, 5).astype(np.float32)
    once = torch.ones(len(places), dtype=torch.float64)
    values = nearest.Values(places, torch.from_numpy(scores), once)
    posterior = nearest.given(Prior(Kernel.of_one(4.0, 0.1, 0.5)), values, 0)
    found = posterior.answer(torch.from_numpy(spread(7, 6, (60.0, 40.0, 1.0))))
    return {"mean": found.mean.numpy(), "variance": found.left.numpy()}


def power_process_exact() -> Arrays:
    """Two lengths about a distance law."""
    return _powers(TWO, LAW, 0)


def power_process_constant() -> Arrays:
    """One length about a constant."""
    return _powers(ONE, None, 0)


def power_process_censored() -> Arrays:
    """The same where nothing was heard in ten rows: expectation propagation."""
    return _powers(TWO, LAW, 10)


def _powers(kernel: Kernel, law: Law | None, quiet: int) -> Arrays:
    process, _ = powers.conditioned(rows(PLACES, quiet), trend(PLACES, law), kernel, 0)
    mean, variance, unknown = process.answer(torch.from_numpy(QUERIES))
    at = torch.from_numpy(QUERIES).requires_grad_()
    process.mean_at(at).sum().backward()
    return {
        "mean": mean.numpy(), "variance": variance.numpy(), "unknown": unknown.numpy(),
        "slope": at.grad.numpy(), "given": process.posterior.values()[:, 0].numpy(),
        "covariance": process.posterior.covariance(torch.from_numpy(QUERIES)).numpy(),
    }  # fmt: skip


def power_left_out_density() -> Arrays:
    """Leave-one-out density of powers, its amplitude and slopes."""
    found = {}
    distance, terms, values = power_settings._views(rows(PLACES), trend(PLACES))
    for name, kernel in (("one", ONE), ("two", TWO)):
        for bounded in (False, True):
            at = torch.from_numpy(kernel.parameters()).requires_grad_()
            gram = density.gram_of(at, distance, terms)
            nats, amplitude = density.LeftOutDensity.apply(gram, values, 1, bounded)
            (slope,) = torch.autograd.grad(nats, at)
            found[f"{name}{bounded}"] = np.array([nats.item(), amplitude.item(), *slope])
    return found


def censored_evidence() -> Arrays:
    """Evidence with rows below their level, and its slopes."""
    told = rows(PLACES, 14)
    distance, terms, values = power_settings._views(told, trend(PLACES))
    gram = 20.0 * density.gram_of(torch.from_numpy(TWO.parameters()), distance, terms)
    value, slope = censored.log_evidence(gram, values[:, 0], torch.from_numpy(told.silent))
    return {"evidence": np.array(value), "slope": slope.numpy()}


def nearest_powers() -> Arrays:
    """Powers given the nearest of many rows, some of them pseudo-values of silent ones."""
    places = spread(900, 7, (300.0, 200.0, 2.0))
    told, about = rows(places, seed=3), trend(places)
    decibels = torch.from_numpy(np.r_[told.decibels, told.decibels[40:80]])
    values = nearest.Values.of(np.r_[told.places, told.places[:40]], decibels[:, None])
    quiet = spread(20, 8, (300.0, 200.0, 2.0)) + 0.5
    level = torch.full((20, 1), -95.0, dtype=torch.float64)
    silent = nearest.Values(quiet, level, torch.ones(20, dtype=torch.float64))
    prior, extra = Prior(TWO, about), torch.from_numpy(np.linspace(0.1, 2, 20))
    posterior = nearest.given(prior, values, 0, silent, extra)
    share = values.count / values.count.sum()
    middle = (share * values.values[:, 0]).sum()
    heard = float((share * (values.values[:, 0] - middle).square()).sum()) / TWO.amplitude
    process = powers.PowerProcess(posterior, heard)
    mean, variance, unknown = process.answer(torch.from_numpy(spread(8, 9, (300.0, 200.0, 2.0))))
    left, spread_left = posterior.left_out()
    at = torch.from_numpy(spread(4, 10, (300.0, 200.0, 2.0))).requires_grad_()
    process.mean_at(at).sum().backward()
    return {
        "mean": mean.numpy(), "variance": variance.numpy(), "unknown": unknown.numpy(),
        "left_out": left[:, 0].numpy(), "left_variance": TWO.amplitude * spread_left.numpy(),
        "slope": at.grad.numpy(), "terms": posterior.terms[:, 0].numpy(),
        "terms_covariance": posterior.spread.numpy(),
    }  # fmt: skip


def nearest_density() -> Arrays:
    """Density of rows given their neighbours, its amplitude and slopes by settings."""
    places = torch.from_numpy(spread(40 * 9, 11)).view(40, 9, 3)
    values = torch.from_numpy(smooth(places.flatten(0, 1).numpy(), 3, 12)).view(40, 9, 3)
    count = torch.arange(360, dtype=torch.float64).view(40, 9) % 3 + 1
    found = {}
    for name, kernel, part in (("one", ONE, values[..., :1]), ("two", TWO, values)):
        at = torch.from_numpy(kernel.parameters()).requires_grad_()
        nats, amplitude = nearest.density_given_nearest(at, nearest.Sample.of(places, part, count))
        (slope,) = torch.autograd.grad(nats, at)
        found[name] = np.array([nats.item(), amplitude.item(), *slope])
    return found


def left_out_beyond_gaps() -> Arrays:
    """Rows predicted without their neighbours, real and complex."""
    inverse = np.linalg.inv(Kernel.of_one(3.0, 0.05).gram(torch.from_numpy(PLACES)).numpy())
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
            told = features.whitened(at, 2.0, 0.05, name, most)
            own = features.correlation(torch.from_numpy(QUERIES), told.places, 2.0, name) @ told.whitening
            found |= {
                f"{name}{most}_places": told.places.numpy(),
                f"{name}{most}_known": (own @ own.T).numpy(),
                f"{name}{most}_mean": (own @ (told.weigh @ values)).numpy(),
            }
    return found


def variance_of_places() -> Arrays:
    """What places alone leave unknown of others (`gp_variance` of the confidences)."""
    return {"variance": process_variance(Kernel.of_one(2.0, 0.1), PLACES, QUERIES)}
