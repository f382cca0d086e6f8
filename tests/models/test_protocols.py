"""What a method declares by the protocols of `gsparc.models.method`, and that it keeps to it.

Methods are fitted once, on tiny data.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import kinds
import numpy as np
import pytest
import torch
from campaigns import RENDERED, channels, compose, powers, spectra
from contexts import short
from rooms import directed, shoebox

from gsparc.data.load import load
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, SplitSettings, make_split
from gsparc.field.gaussians import FieldSettings
from gsparc.models import method as protocols
from gsparc.models.channels import complex_gp
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.method import Differentiable, Method, Reducible
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings
from gsparc.models.registry import METHODS, build, method_class
from gsparc.models.splat.array import ArrayField
from gsparc.ops import Pose
from gsparc.training.context import FitContext

DECLARED = {
    **dict.fromkeys(("zero", "mean", "nearest", "idw", "kriging", "ridge", "fire", "uplink"), ""),
    **dict.fromkeys(("gsrf", "wrfgs", "swiftwrf", "nerf2", "ngrf", "newrf"), ""),
    "calibrated_raytracer": "",
    "distance_law": "Differentiable",
    "gp": "Differentiable Reducible",
    "complex_gp": "Differentiable LeaveOneOut",
    "directional_gp": "Differentiable LeaveOneOut HasPaths",
    "image_source_gp": "LeaveOneOut HasPaths Reducible",
    "array": "Differentiable Reducible",
    "moving_array": "Reducible",
    "gsparc": "Differentiable HasPaths Reducible",
}
VARIANCE = (
    "kriging", "distance_law", "gp", "complex_gp", "directional_gp", "image_source_gp", "array",
    "moving_array",
)  # fmt: skip
PROTOCOLS = sorted({word for words in DECLARED.values() for word in words.split()})
FILES = {  # of rendered Gaussians, by what they render
    "gsparc": spectra,
    "gsparc of a moving array": lambda path: spectra(path, moving="rx"),
    "gsparc of channels": lambda path: channels(path, shape="S"),
    "gsparc of powers": powers,
}


def having(protocol: str) -> list[str]:
    return [name for name, words in DECLARED.items() if protocol in words.split()]


def data_of(name: str, folder: Path) -> Measurements:
    if name in FILES:
        return load({"name": "own", "file": str(FILES[name](folder / "own.npz"))})
    if name == "directional_gp":
        return directed(60)[0]
    if name in ("image_source_gp", "gsparc of sources"):
        return shoebox(60)[1]
    if name == "array":
        return kinds.static_array(folder)
    if name == "moving_array":
        return kinds.moving_array(folder)
    make = {"gp": kinds.images, "complex_gp": kinds.gains}.get(name, kinds.received)
    return make(folder)


def unfitted(name: str) -> Method:
    few = ("model.field.count=40", "model.keep_best=false")
    if name in FILES:
        return build(compose("model=gsparc", *RENDERED, *few).model)
    if name == "gsparc of sources":
        return build(compose("model=gsparc", "init.searches=1", "init.search_rows=60").model)
    if name == "image_source_gp":
        return ImageSourceGP(searches=1, search_rows=60, clutter=False)
    if name == "array":
        return ArrayField(FieldSettings(count=64))
    if name == "moving_array":
        search = SearchSettings(sources=8, rows=30, candidates=1000, steps=20)
        return MovingArrayField(search=search, components=32)
    return method_class(name.removesuffix(" of powers"))()


@cache
def fitted(name: str) -> tuple[Method, Measurements, Fold]:
    with TemporaryDirectory() as folder:
        data, method = data_of(name, Path(folder)), unfitted(name)
        fold = make_split(data.moving, SplitSettings()).folds[0]
        method.fit(data, fold, short(Path(folder), 10, budget_s=3.0 if method.takes_budget else None))
    return method, data, fold


def places(method: Method, count: int = 5) -> torch.Tensor:
    """Of the moving end (count, 3) float64 [m], in the scene's box."""
    assert method.site is not None
    low, high = torch.from_numpy(method.site.box).double()
    draw = torch.Generator().manual_seed(0)
    return low + (0.2 + 0.6 * torch.rand(count, 3, generator=draw, dtype=torch.float64)) * (high - low)


def ends(method: Method, moving: torch.Tensor) -> tuple[torch.Tensor, Pose]:
    """Both ends, the moving one at places (B, 3); the static one where it stood."""
    site = method.site
    assert site is not None
    still = torch.zeros(3) if site.static_position is None else torch.from_numpy(site.static_position).float()
    if site.moving_end == "rx":
        return still.expand(len(moving), 3), Pose.identity(moving)
    turn = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    return moving, Pose(still, torch.from_numpy(turn).float())


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_what_the_table_says(name):
    method = method_class(name)()
    kept_to = {word for word in PROTOCOLS if isinstance(method, getattr(protocols, word))}
    assert kept_to == set(DECLARED[name].split())
    assert method.resumable == (name in ("image_source_gp", "gsparc"))


@pytest.mark.parametrize("name", VARIANCE)
def test_predictions_have_a_variance(name):
    method = fitted(name)[0]
    variance = method.predict(*ends(method, places(method).float())).variance
    assert variance is not None and variance.shape == (5,)
    assert variance.dtype == torch.float32 and (variance > 0).all()


@pytest.mark.parametrize("name", [*having("Differentiable"), "gp of powers"])
def test_gradients_are_those_of_the_predicted_mean(name):
    method = fitted(name)[0]
    assert isinstance(method, Differentiable)
    # What is computed in float32 is asked in float32, with steps that rounding does not hide.
    exact = name not in ("gsparc", "array")
    where = places(method).to(torch.float64 if exact else torch.float32)
    with torch.no_grad():
        said, mean = method.predict(*ends(method, where)).mean, method.mean_at(*ends(method, where))
    assert method.site is not None
    shown = mean.clamp(0, 1) if method.site.kind == "spectrum" else mean  # spectra are shown clamped
    torch.testing.assert_close(shown, said, rtol=1e-4, atol=1e-5 * float(said.abs().max()))
    draw = torch.Generator().manual_seed(1)
    weights = torch.randn(mean.shape, generator=draw, dtype=mean.dtype)

    def summed(moving: torch.Tensor) -> torch.Tensor:
        """A sum (B,) of the mean's entries, in float64."""
        product = method.mean_at(*ends(method, moving)) * weights
        return torch.real(product).double().flatten(1).sum(1)

    asked = where.clone().requires_grad_()
    (slope,) = torch.autograd.grad(summed(asked).sum(), asked)
    step = 3e-4 if exact else 3e-3
    with torch.no_grad():
        for axis in torch.eye(3, dtype=where.dtype):
            found = (summed(where + step * axis) - summed(where - step * axis)) / (2 * step)
            wanted = (slope * axis).sum(1).double()
            torch.testing.assert_close(found, wanted, rtol=0.02, atol=0.02 * float(slope.abs().max()))
    assert slope.abs().max() > 0


@pytest.mark.parametrize("name", [*list(FILES)[1:], "gsparc of sources"])
def test_what_has_no_gradients_says_so(name):
    """Footprints are projected without any: a moving receiver's would lack most of what changes."""
    method = fitted(name)[0]
    assert isinstance(method, Differentiable)
    with pytest.raises(ValueError, match="no gradients"):
        method.mean_at(*ends(method, places(method).float().requires_grad_()))


def test_left_out_rows_are_predicted_by_a_fit_without_them(monkeypatch):
    _, data, fold = shoebox(24)
    known = np.concatenate([fold.train, fold.val])
    none = known[:0]

    def fit(rows: np.ndarray) -> complex_gp.ComplexGP:
        method = complex_gp.ComplexGP()
        method.fit(data, Fold(rows, none, none), FitContext())
        return method

    monkeypatch.setattr(complex_gp, "LENGTHS", (1.0,))  # a row less must not choose another kernel
    monkeypatch.setattr(complex_gp, "NOISES", (1e-2,))
    residual = fit(known).leave_one_out().residual
    for number in (0, len(known) // 2, len(known) - 1):
        batch = data.batch(known[[number]])
        missed = batch.target - fit(np.delete(known, number)).predict(batch.tx, batch.rx).mean
        torch.testing.assert_close(residual[number].to(missed.dtype), missed.flatten(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("gp", {"keep": 0.5, "confidence": False}),
        ("array", {"keep": 0.5}),
        ("moving_array", {"keep": 0.5}),
        ("gsparc", {"keep": 0.5, "confidence": False}),
    ],
)
def test_a_reduction_leaves_the_method_as_it_was(name, settings):
    method, data, fold = fitted(name)
    assert isinstance(method, Reducible) and set(settings) <= set(method.knobs())
    query = ends(method, places(method).float())
    before = method.predict(*query)
    less = method.reduced(settings, method.contributions(data, fold.train))
    assert not torch.equal(less.predict(*query).mean, before.mean)
    after = method.predict(*query)
    for part in ("mean", "confidence", "variance"):
        one, two = getattr(before, part), getattr(after, part)
        assert (one is None and two is None) or torch.equal(one, two)
