"""Gradients of predictions by position: right, in the caller's precision, or refused."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import kinds
import numpy as np
import pytest
import torch
from campaigns import RENDERED, compose, spectra
from closed import fitted_to
from contexts import short
from refusals import refused
from rooms import directed, shoebox
from torch.autograd import forward_ad

from gsparc.data.schema import Measurements
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold, make_split
from gsparc.datasets.load import load
from gsparc.models.baselines import gp
from gsparc.models.channels import complex_gp
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.closed_form import ClosedForm
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.method import Method, MethodFactory, Prediction
from gsparc.models.mixture.methods import Powers
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings as BearingSearchSettings
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import build, method_class
from gsparc.ops import Pose
from gsparc.prediction.predictor import Predictor
from gsparc.processes import powers
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext, FitReport

WORLD = np.array([430.0, -510.0, 12.0])  # float32 moves in steps of 30 micrometres there
UTM = np.array([4.3e5, -5.1e6, 120.0])  # and of half a metre there
STEP = 4e-5  # [m] of differences of fourth order


def both_ends(kind: str) -> Measurements:
    """Two ends that move in a room: the direct wave, or its power with 0.3 dB of noise."""
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform([0, 0, 1], [4, 3, 2], (2, 120, 3))
    far = np.linalg.norm(tx - rx, axis=1) + 0.5
    ends = {"tx_position": tx, "rx_position": rx, "frequency_hz": np.array(3e8)}
    if kind == "csi":
        return from_arrays({**ends, "csi": np.exp(-2j * np.pi * far) / far})
    return from_arrays({**ends, "rssi_db": -20 * np.log10(far) + 0.3 * rng.standard_normal(120)})


def antennas() -> Measurements:
    """Channels from a place to three antennas of a room, at a wavelength of 30 cm."""
    rng = np.random.default_rng(0)
    at, end = (
        rng.uniform([0, 0, 0.7], [1.5, 1.5, 0.9], (80, 3)),
        rng.uniform([0, 0, 2], [2, 2, 2.4], (3, 3)),
    )
    far = np.linalg.norm(at[:, None] - end, axis=-1)
    noise = 0.02 * (rng.standard_normal((80, 3, 2)) @ [1, 1j])
    csi = np.exp(-2j * np.pi * far / 0.3) / far + noise
    return from_arrays(
        {"tx_position": at, "station_position": end, "csi": csi, "frequency_hz": np.array(1e9)}
    )


def images(folder: Path, rows: int, moving: str = "tx") -> Measurements:
    return load({"name": "own", "file": str(spectra(folder / "own.npz", rows, moving))})


def planned(*more: str) -> Callable[[], MethodFactory]:
    return lambda: build(compose("model=gsparc", *more).model)


class Assembled(Powers):
    """What `method` found, with a process of waves beside it where it is one of channels."""

    def __init__(self, method: ClosedForm) -> None:
        super().__init__()
        self.method = method

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        self.site, report = data.site, self.method.fit(data, fold, context)
        self.members, self.weights = [self.method], (1.0,)
        if not isinstance(self.method, MovingArrayField):
            waves, _ = fitted_to(ChannelField(ChannelSettings()), data, fold.train)
            self.members, self.weights = [self.method, waves], (0.6, 0.4)
        return report


class Case(NamedTuple):
    """What is fitted to which data; `station` of several, `thin`:
    how few rows make it take the nearest.
    """

    make: Callable[[], Method]
    data: Callable[[Path], Measurements]
    station: str | None = None
    thin: bool = False


SEARCH = BearingSearchSettings(sources=8, rows=30, candidates=1000, steps=20)
SOURCES = ("init.searches=1", "init.search_rows=60")
CASES = {
    "gp, spectra": Case(method_class("gp"), kinds.images),
    "gp, spectra, nearest rows": Case(
        method_class("gp"), lambda folder: images(folder, 200), thin=True
    ),
    "gp, spectra of a moving receiver": Case(
        method_class("gp"), lambda folder: images(folder, 40, "rx")
    ),
    "array": Case(lambda: method_class("array")(), kinds.static_array),
    "gsparc, rendered": Case(planned(*RENDERED, "model.field.count=40"), kinds.images),
    "gsparc, array": Case(planned("model.field.count=64"), kinds.static_array),
    "moving_array": Case(
        lambda: MovingArrayField(search=SEARCH, components=32), kinds.moving_array
    ),
    "gsparc, moving array": Case(
        lambda: Assembled(MovingArrayField(search=SEARCH, components=32)), kinds.moving_array
    ),
    "gp, channels": Case(method_class("gp"), kinds.bands),
    "complex_gp": Case(method_class("complex_gp"), kinds.gains),
    "complex_gp, nearest rows": Case(method_class("complex_gp"), kinds.gains, thin=True),
    "complex_gp, both ends": Case(method_class("complex_gp"), lambda _: both_ends("csi")),
    "directional_gp": Case(method_class("directional_gp"), lambda _: directed(60)[0]),
    "image_source_gp": Case(
        lambda: ImageSourceGP(searches=1, search_rows=60), lambda _: shoebox(60, pillar=True)[1]
    ),
    "gsparc, a mixture": Case(
        lambda: Assembled(ImageSourceGP(searches=1, search_rows=60)), kinds.bands
    ),
    "gsparc, channels of an array": Case(planned(*SOURCES), kinds.bands),
    "gsparc, channels from nowhere known": Case(planned(), kinds.unplaced),
    "gsparc, channels of stations": Case(planned(), lambda _: antennas(), "0"),
    "gsparc, channels of both ends": Case(planned(), lambda _: both_ends("csi")),
    "distance_law": Case(method_class("distance_law"), kinds.received),
    "gp, powers": Case(method_class("gp"), kinds.received),
    "gp, powers, nearest rows": Case(method_class("gp"), kinds.received, thin=True),
    "gp, powers of both ends": Case(method_class("gp"), lambda _: both_ends("rssi")),
    "gsparc, powers": Case(planned(), kinds.received),
    "gsparc, powers of stations": Case(planned(), kinds.several, "0"),
}
REFUSED = {
    "nearest": "change in jumps",
    "idw": "change in jumps",
    "mean": "same everywhere",
    "zero": "same everywhere",
    "kriging": "outside of autograd",
    "gsparc": "footprints",
}
QUICK = (
    "gp, spectra",
    "complex_gp, both ends",
    "gp, powers, nearest rows",
    "gsparc, powers of stations",
)


@cache
def fitted(name: str) -> tuple[Predictor, Measurements]:
    """The predictor of a case, its world's origin far away; and what it learned from."""
    case = CASES[name]
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        data = case.data(Path(folder))
        if case.thin:
            for module in (gp, complex_gp, powers):
                patch.setattr(module, "MOST_ROWS", 30)
            patch.setattr(complex_gp, "NEAREST", 20)
        method = wrap_per_station(case.make(), data).create_for(data)
        fold = make_split(data.moving, SplitSettings(), place=data.place).folds[0]
        method.fit(data, fold, short(Path(folder), 10, effort=0.1))
    site = type(data.site)(**{**vars(data.site), "origin": data.site.origin + WORLD})
    found = Predictor(method, site)
    return found if case.station is None else found.select_station(int(case.station)), data


def places(predictor: Predictor, count: int = 3) -> torch.Tensor:
    """Of what moves (count, 3 or 6) float64 [m, world], in the scene."""
    low, high = torch.from_numpy(predictor.site.query_box).double()
    draw = torch.Generator().manual_seed(0)
    local = low + (0.2 + 0.6 * torch.rand(count, len(low), generator=draw, dtype=torch.float64)) * (
        high - low
    )
    return local + torch.from_numpy(predictor.site.origin).repeat(len(low) // 3)


def ends(predictor: Predictor, at):
    """Where both are: what moves at places (..., 3 or 6),
    what stands where nobody knows at the origin.
    """
    site = predictor.site
    if site.static_end is None:
        return {"tx": at[..., :3], "rx": at[..., 3:]}
    unknown = site.kind == "csi" and site.static_position is None
    return {site.moving_end: at, **({site.static_end: site.origin} if unknown else {})}


def answer(predictor: Predictor, at: torch.Tensor) -> Prediction:
    return predictor.predict(**ends(predictor, at), grad=True)


def asked(predictor: Predictor, at: torch.Tensor, **more: bool):
    return getattr(predictor, predictor.site.kind)(**ends(predictor, at), **more)


def sums(predictor: Predictor, at: torch.Tensor) -> dict[str, torch.Tensor]:
    """One number (B,) each of mean, variance and confidence, of size one."""
    found = answer(predictor, at)
    shape, draw = (2, *found.mean.shape[1:]), np.random.default_rng(1)
    weights = torch.complex(*torch.from_numpy(draw.standard_normal(shape)))
    parts = {"mean": torch.real(found.mean * weights).flatten(1).sum(1)}
    # Of a distance law the same decibels everywhere: no slope but of rounding.
    others = (
        ("confidence",) if predictor.method.name == "distance_law" else ("variance", "confidence")
    )
    parts |= {name: part for name in others if (part := getattr(found, name)) is not None}
    return parts


def slopes(predictor: Predictor, at: torch.Tensor) -> dict[str, torch.Tensor]:
    """Reverse mode: (B, D) of each of `sums`."""
    leaf = at.clone().requires_grad_()
    parts = sums(predictor, leaf)
    return {
        name: torch.autograd.grad(part.sum(), leaf, retain_graph=True)[0]
        for name, part in parts.items()
        if part.requires_grad
    }


def differences(
    predictor: Predictor, at: torch.Tensor, step: float = STEP
) -> dict[str, torch.Tensor]:
    """Central differences of fourth order: (B, D) of each of `sums`."""
    columns: dict[str, list[torch.Tensor]] = {}
    for axis in torch.eye(at.shape[1], dtype=at.dtype):
        with torch.no_grad():
            near, far = (
                [sums(predictor, at + h * n * step * axis) for h in (1, -1)] for n in (1, 2)
            )
        for name in near[0]:
            first, second = (pair[0][name] - pair[1][name] for pair in (near, far))
            columns.setdefault(name, []).append((8 * first - second) / (12 * step))
    return {name: torch.stack(parts, 1) for name, parts in columns.items()}


def error(found: torch.Tensor, wanted: torch.Tensor) -> float:
    """Largest error over the largest slope."""
    return float((found - wanted).abs().max() / wanted.abs().max().clamp_min(1e-300))


def equal_differences(predictor, data):
    at = places(predictor)
    # A pixel that reaches 0 within a step has no difference there: by a twentieth it has.
    found, wanted = (
        slopes(predictor, at),
        [differences(predictor, at, s) for s in (STEP, STEP / 20)],
    )
    assert "mean" in found
    for part, slope in found.items():
        assert slope.dtype == torch.float64 and slope.abs().max() > 0, part
        assert min(error(slope, one[part]) for one in wanted) < 1e-5, part
    for part in set(wanted[0]) - set(found):
        assert wanted[0][part].abs().max() == 0, part


def leave_answers_as_they_are(predictor, data):
    """In the caller's precision; float32 loses nothing but its last digits near the world's
    origin.
    """
    at = places(predictor)
    with_gradients, plain = asked(predictor, at, grad=True), asked(predictor, at)
    assert with_gradients.dtype == (torch.complex128 if plain.is_complex() else torch.float64)
    assert plain.dtype == (torch.complex64 if plain.is_complex() else torch.float32)
    assert not plain.requires_grad
    assert error(with_gradients, plain) < 2e-3
    site = predictor.site
    near = Predictor(predictor.method, type(site)(**{**vars(site), "origin": site.origin - WORLD}))
    shift = torch.from_numpy(WORLD).repeat(at.shape[1] // 3)
    single = (at - shift).float().requires_grad_()
    found = asked(near, single, grad=True)
    assert found.dtype == plain.dtype
    (slope,) = torch.autograd.grad(torch.real(found).sum(), single)
    double = at.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(torch.real(asked(predictor, double, grad=True)).sum(), double)
    assert slope.dtype == torch.float32 and error(slope, wanted) < 1e-3


def are_finite_at_rows_and_at_one_place(predictor, data):
    rows = data.moving[:2] if data.station is None else data.moving[data.station == 0][:2]
    origin = torch.from_numpy(predictor.site.origin)
    at = torch.from_numpy(np.asarray(rows, np.float64)) + origin.repeat(rows.shape[1] // 3)
    for slope in slopes(predictor, at).values():
        assert torch.isfinite(slope).all()
    one = at[0].clone().requires_grad_()
    found = asked(predictor, one, grad=True)
    assert found.shape == asked(predictor, at, grad=True).shape[1:]
    (slope,) = torch.autograd.grad(torch.real(found).sum(), one)
    assert slope.shape == one.shape and torch.isfinite(slope).all()


PROPERTIES = (
    equal_differences,
    leave_answers_as_they_are,
    are_finite_at_rows_and_at_one_place,
)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradients(name):
    for hold in PROPERTIES:
        hold(*fitted(name))


@pytest.mark.parametrize("name", REFUSED)
def test_models_without_gradients_say_so(name, tmp_path):
    rendered = name == "gsparc"  # of a moving receiver
    data = images(tmp_path, 40, "rx") if rendered else kinds.received(tmp_path)
    more = (*RENDERED, "model.field.count=10", "model.keep_best=false")
    method = (planned(*more) if rendered else method_class(name))().create_for(data)
    method.fit(data, make_split(data.moving, SplitSettings()).folds[0], short(tmp_path, 2))
    with pytest.raises(ValueError, match=f"{name} has no gradients by position: .*{REFUSED[name]}"):
        getattr(Predictor(method, data.site), data.site.kind)(rx=torch.zeros(3), grad=True)


@pytest.mark.parametrize("name", QUICK)
def test_wrong_questions_get_clear_answers(name):
    predictor, _ = fitted(name)
    at, end = places(predictor), predictor.site.moving_end
    refused("must be a torch tensor, got ndarray", asked, predictor, at.numpy(), grad=True)
    if predictor.site.static_position is not None:
        still = torch.from_numpy(
            predictor.site.static_position + predictor.site.origin
        ).requires_grad_()
        with pytest.raises(ValueError, match=f"gradients are by the position of {end} alone"):
            predictor.predict(**{end: at, predictor.site.static_end: still}, grad=True)
    for transform in (torch.func.vmap, torch.func.jacrev, torch.func.jacfwd):
        answers = transform(lambda place: asked(predictor, place, grad=True))
        refused("forward mode are not followed", answers, at)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(at, torch.ones_like(at))
        refused("forward mode are not followed", asked, predictor, dual, grad=True)
    if predictor.site.kind == "csi":
        refused(
            "measured tones alone", predictor.csi, tx=at[:, :3], rx=at[:, 3:], symbols=14, grad=True
        )


def test_the_origin_is_taken_away_in_float64_and_turns_have_no_gradient():
    predictor, _ = fitted("complex_gp")
    site, at = predictor.site, places(predictor)
    far = Predictor(predictor.method, type(site)(**{**vars(site), "origin": site.origin + UTM}))
    there = slopes(far, at + torch.from_numpy(UTM))
    for part, slope in slopes(predictor, at).items():
        assert error(there[part], slope) < 1e-6, part
    pose = Pose(at, torch.eye(3, dtype=at.dtype).repeat(len(at), 1, 1).requires_grad_())
    refused("gradients are by the position of rx alone", predictor.csi, rx=pose, grad=True)
