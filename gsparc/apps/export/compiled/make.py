"""Which compiled form a model is, exactly or distilled,
and how far its answers are from the model's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gsparc.apps.export.compiled.blob import Form
from gsparc.apps.export.compiled.channels import compile_mean, compile_sources
from gsparc.apps.export.compiled.powers import compile_powers
from gsparc.apps.export.compiled.spectra import compile_array, compile_view
from gsparc.data.schema import Measurements, Site
from gsparc.data.target import Kind
from gsparc.field.frozen import FrozenArray, FrozenView
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.method import Method
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.per_station import PerStation
from gsparc.models.powers.field import PowerField
from gsparc.models.splat.image_process import ImageProcess
from gsparc.models.splat.method import LearnedField
from gsparc.ops import Pose
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.answers import ask
from gsparc.prediction.predictor import Predictor

ANSWERED = 3000  # places that distilled powers are made from


@dataclass(frozen=True)
class CompiledForm:
    """A form and how far it is from its model.

    Attributes:
        form: to be written.
        error: over random places, the figure in `FIGURES`; 0: none but rounding.
        worst: the same of the worst place, those near the end that stands included.
        summary: in words, for people.
    """

    form: Form
    error: float
    worst: float
    summary: str


# As `gsparc evaluate` has them.
FIGURES: dict[Kind, str] = {"spectrum": "MSE", "csi": "NMSE", "rssi": "RMSE dB"}
NEAREST = 1e-3  # of the way to the other end: where the largest errors are looked for
# One far place for so many; widths of the box that are away, at most
FAR_SHARE, FARTHEST = 8, 300.0
SILENT = 1e-6  # of the model's power: more than 60 dB below are 60


def compile_model(predictor: Predictor, count: int = 4096, seed: int = 0) -> CompiledForm:
    """Return the form of a model of one station, its error measured at `count` random places, and a
    quarter more near the other end, where powers are largest.

    Raises:
        ValueError: no form answers as this model does, or it is of several stations.
    """
    method, site = predictor.method, predictor.site
    if isinstance(method, PerStation):
        raise ValueError(f"station= is needed, one of {', '.join(site.every_station.name)}")
    if site.paired and not site.target.is_level:
        advice = "take a model of powers, or one end that stands still"
        raise ValueError(
            f"to=c: channels and spectra of two moving ends have no compiled form; {advice}"
        )
    # An exact form is not measured: its error is that of rounding to float32.
    exact = compile_exactly(method, site)
    if exact is not None:
        summary = f"{_NAMES[exact.kind]}, exactly"
        if lost := exact.variance_lost:
            summary += f"; variances of {lost:.1%} more in the mean"
        return CompiledForm(exact, 0.0, 0.0, summary)
    form = distil_form(predictor, seed)
    assert form.predictor is not None
    # Other seeds than that of the places distilled from,
    # or the error would be that of known places.
    near = near_places(site, max(1, count // 4), seed + 2)
    places = np.concatenate([random_places(site, count, seed + 1), near])
    squared, power = _squares(form.predictor, predictor, places)
    # The worst may be near the station, the mean is over random places alone.
    errors = np.array([squared[:count].mean(), squared.max()])
    shares = errors / max(power[:count].mean(), 1e-300)
    errors = (
        shares if site.target.is_complex else np.sqrt(errors) if site.target.is_level else errors
    )
    error, worst = np.maximum(errors, 1e-12).tolist()
    figure = f"{FIGURES[site.kind]} {error:.2g} at {count} random places, {worst:.2g} at the worst"
    if site.target.is_level:
        away, _ = _squares(form.predictor, predictor, far_places(site, 256, seed + 4))
        rms, most = np.sqrt([away.mean(), away.max()])
        figure += f", outside their box {rms:.2g}, {most:.2g} at the worst"
    how = f"distilled from {method.name}"
    if site.target.is_image:
        how = f"of {method.name} without the process averaged in"
        figure += f", {shares[0]:.2g} and {shares[1]:.2g} of its answers' mean square"
    return CompiledForm(form, error, worst, f"{_NAMES[form.kind]}, {how}: {figure}")


def _squares(form: Predictor, model: Predictor, places: np.ndarray) -> np.ndarray:
    """Mean square of errors, and of the model's answers, of each local place (2, n),
    see `FIGURES`.
    """
    answers, whole = (ask_model(asked, places).reshape(len(places), -1) for asked in (form, model))
    if model.site.target.is_level:
        # A power of 0 has no decibels; 1e-30 is far below any receiver's noise.
        whole = np.maximum(whole, 1e-30)
        answers, whole = to_decibels(np.maximum(answers / whole, SILENT)), np.zeros_like(whole)
    squared, power = (
        np.square(np.abs(levels).astype(np.float64)).mean(1) for levels in (answers - whole, whole)
    )
    return np.stack([squared, power])


_NAMES = dict(
    enumerate(
        (
            "an array's spectrum",
            "a frozen image",
            "a sum of sources",
            "a process of powers",
            "a mean of several such",
        ),
        1,
    )
)


def compile_exactly(method: Method, site: Site) -> Form | None:
    """Return the form whose answers are the model's but for rounding; None where there is none."""
    if isinstance(method, Mixture):
        forms = [compile_exactly(member, site) for member in method.members]
        known = [form for form in forms if form is not None]
        whole = len(known) == len(forms)
        return compile_mean(known, method.weights, method.doubt) if whole else None
    if isinstance(method, PowerField):
        if method.powers is None:
            return None
        return compile_powers(method.powers, site.target_scale)
    if isinstance(method, ImageProcess) and method._average is not None:
        return compile_exactly(method._average[0], site) if not method.count_components() else None
    if isinstance(method, LearnedField):
        return _rendered(method, site)
    if isinstance(method, GaussianProcess):
        return None if method.powers is None else compile_powers(method.powers, site.target_scale)
    if isinstance(method, (ImageSourceGP, DirectionalGP)):
        return compile_sources(method, site)
    return None


def _rendered(method: LearnedField, site: Site) -> Form | None:
    if not site.target.is_image or site.static_position is None:
        return None
    rotation = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    place = torch.from_numpy(np.asarray(site.static_position, np.float32))
    frozen = method.frozen_at(Pose(place, torch.from_numpy(np.asarray(rotation, np.float32))))
    if isinstance(frozen, FrozenArray):
        return compile_array(method.fitted_model(), frozen)
    return compile_view(frozen) if isinstance(frozen, FrozenView) else None


def distil_form(predictor: Predictor, seed: int) -> Form:
    """Return a form near a model: its array's part alone, or a process of powers given its answers
    at random places.

    Raises:
        ValueError: channels that are not made of sources, or spectra that are not rendered.
    """
    method, site = predictor.method, predictor.site
    alone = method.without_process()
    own_form = _rendered(alone, site) if isinstance(alone, LearnedField) else None
    if alone is not None and own_form is not None:
        return replace(own_form, predictor=Predictor(alone, site))
    if site.target.is_image:
        raise ValueError(
            f"{method.name}: of spectra only rendered Gaussians can be compiled (model=gsparc)"
        )
    if site.target.is_complex:
        able = "model=image_source_gp, directional_gp, or gsparc with model.effects.residual=false"
        raise ValueError(
            f"{method.name}: channels that are no sum of sources have no compiled form; take {able}"
        )
    if not site.target.is_level:
        raise ValueError(f"{method.name}: {site.target.called} have no compiled form")
    # The law of distance goes on outside the box
    far = far_places(site, ANSWERED // FAR_SHARE, seed)
    data = sample_model(predictor, np.concatenate([random_places(site, ANSWERED, seed), far]))
    # All rows are learned from: a model's answers have no noise
    # that validation would guard against.
    process = GaussianProcess()
    process.condition(data, np.arange(len(data)))
    form = compile_exactly(process, site)
    assert form is not None
    return replace(form, predictor=Predictor(process, site))


def random_places(site: Site, count: int, seed: int) -> np.ndarray:
    """Return local places (count, 3) of what moves, (count, 6) of both ends [m],
    in the box of the measured.
    """
    low, high = site.moving_box
    return np.random.default_rng(seed).uniform(low, high, (count, len(low))).astype(np.float32)


def far_places(site: Site, count: int, seed: int) -> np.ndarray:
    """Return places like `random_places`, moved away from the middle,
    evenly in the logarithm of how much.
    """
    places, middle = random_places(site, count, seed + 3), site.moving_box.mean(axis=0)
    away = FARTHEST ** np.random.default_rng(seed + 3).uniform(size=(count, 1))
    flat = np.tile([1, 1, 0], places.shape[1] // 3).astype(bool)  # heights stay
    return np.where(flat, middle + away * (places - middle), places).astype(np.float32)


def near_places(site: Site, count: int, seed: int) -> np.ndarray:
    """Return places like `random_places`, the last end nearer to the other,
    evenly in the logarithm of how much.
    """
    places, (low, high) = random_places(site, count, seed), site.moving_box
    other = places[:, :3] if site.paired else site.static_position
    if other is None:  # nobody knows where
        return places
    # Logarithmic: powers, and with them errors, grow by decades towards the end that stands.
    share = NEAREST ** np.random.default_rng(seed).uniform(size=(count, 1))
    places[:, -3:] = (other + share * (places[:, -3:] - other)).clip(low[-3:], high[-3:])
    return places


def ask_model(predictor: Predictor, places: np.ndarray) -> np.ndarray:
    """Return the model's answers (B, ...), powers linear, at local places (B, 3) or (B, 6) [m]."""
    return ask(predictor, predictor.site.world_ends(places), linear=True).mean.numpy()


def sample_model(predictor: Predictor, places: np.ndarray) -> Measurements:
    """Return measurements whose targets are the model's answers at local places [m]."""
    site, count = predictor.site, len(places)
    still = np.zeros(3) if site.static_position is None else site.static_position
    moving = {end: place - site.origin for end, place in site.world_ends(places).items()}
    ends = {end: np.broadcast_to(still, (count, 3)) for end in ("tx", "rx")} | moving
    rotation = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    return Measurements(
        site,
        ends["tx"].astype(np.float64),
        ends["rx"].astype(np.float64),
        np.broadcast_to(rotation, (count, 3, 3)),
        ask_model(predictor, places) / site.target_scale,
    )
