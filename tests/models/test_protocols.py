"""What a method declares by the protocols of `gsparc.models.method`, and that it keeps to it.

Methods are fitted once, on tiny data.
"""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import kinds
import numpy as np
import pytest
import torch
import yaml
from campaigns import RENDERED, channels, compose, spectra
from cities import city, deaf
from contexts import short
from invented import invent
from refusals import refused
from rooms import directed, shoebox
from scenes import fold_of, lobes, room
from worlds import World, arrays

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.load import load
from gsparc.field.gaussians import FieldSettings
from gsparc.models import checkpoint, loading
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.method import Method, MethodFactory, import_path
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings as BearingSearchSettings
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import build, built_in_methods, method_class
from gsparc.models.splat.array import ArrayField
from gsparc.models.uplink.search import SearchSettings as UplinkSearch
from gsparc.ops import Pose
from gsparc.prediction.answers import ask
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

NAMED = ("array_process", "image_process", "image_sources", "channels", "powers", "bearings")
VARIANCE = (
    "kriging",
    "distance_law",
    "gp",
    "complex_gp",
    "directional_gp",
    "image_source_gp",
    "array",
    "moving_array",
)
PLAIN = ("mean", "nearest", "idw", "gp", "kriging")
INVENTED = [(kind, end) for kind in ("spectrum", "csi", "rssi") for end in ("rx", "tx")]
# Settings of trainings that are over at once.
SMALL: dict[str, dict[str, Any]] = {
    **{
        name: {"count": 40, "max_steps": 3}
        for name in ("gsrf", "wrfgs", "swiftwrf", "ngrf", "wideband")
    },
    **{name: {"width": 16, "samples": 8, "max_steps": 3} for name in ("nerf2", "newrf")},
}
UPLINK: dict[str, dict[str, Any]] = {
    "ridge": {},
    "ridge, all antennas": {"inputs": "all"},
    "fire": {"max_steps": 3},
    "uplink": {"search": UplinkSearch(rounds=2, picks=4, final=2), "teachers": 60},
}


MAKES = {  # what others than of received powers are fitted to
    **dict.fromkeys(("gp", "gsparc", "image_process"), kinds.images),
    **dict.fromkeys(("complex_gp", "channels", "image_sources"), kinds.gains),
    **dict.fromkeys(("array", "splat", "array_process"), kinds.static_array),
    **dict.fromkeys(("moving_array", "bearings"), kinds.moving_array),
    **dict.fromkeys(SMALL, lambda folder: lobes(folder)[0]),
    **dict.fromkeys(("carriers", "other_carriers", "direct_beam", "wideband"), kinds.carriers),
    **dict.fromkeys(("ngrf", "newrf"), lambda _: room(40, directions=True)[0]),
    **dict.fromkeys(UPLINK, lambda _: city("all")),
    "ridge, all antennas": lambda _: city(0),  # of one antenna
    "directional_gp": lambda _: directed(60)[0],
    "image_source_gp": lambda _: shoebox(60)[1],
}


def unfitted(name: str) -> MethodFactory:
    if name == "gsparc":
        few = ("model.field.count=40", "model.keep_best=false")
        return build(compose("model=gsparc", *RENDERED, *few).model)
    if name == "image_source_gp":
        return ImageSourceGP(searches=1, search_rows=60, clutter=False)
    if name == "array":
        return ArrayField(FieldSettings(count=64))
    if name in NAMED:
        few = ("init.searches=1", "init.search_rows=60", "init.max_sources=4")
        return build(compose(f"model={name}", *few).model)
    if name == "moving_array":
        search = BearingSearchSettings(sources=8, rows=30, candidates=1000, steps=20)
        return MovingArrayField(search=search, components=32)
    return method_class(name.partition(",")[0])(**{**SMALL, **UPLINK}.get(name, {}))


@cache
def fitted(name: str, layout: str = "") -> tuple[Method, Measurements, Fold]:
    with TemporaryDirectory() as folder:
        data = {"": MAKES.get(name, kinds.received), **LAYOUTS}[layout](Path(folder))
        method = unfitted(name).create_for(data)
        fold = fold_of(data)
        method.fit(data, fold, short(Path(folder), 10, effort=0.1))
    return method, data, fold


def places(method: Method, count: int = 5) -> torch.Tensor:
    """Of the moving end (count, 3) float64 [m], in the scene's box."""
    assert method.site is not None
    low, high = torch.from_numpy(method.site.box).double()
    draw = torch.Generator().manual_seed(0)
    return low + (0.2 + 0.6 * torch.rand(count, 3, generator=draw, dtype=torch.float64)) * (
        high - low
    )


def ends(method: Method, moving: torch.Tensor) -> Query:
    """Both ends, the moving one at places (B, 3); the static one where it stood."""
    site = method.site
    assert site is not None
    still = (
        torch.zeros(3)
        if site.static_position is None
        else torch.from_numpy(site.static_position).float()
    )
    if site.moving_end == "rx":
        return Query(still.expand(len(moving), 3), Pose.identity(moving))
    turn = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    return Query(moving, Pose(still, torch.from_numpy(turn).float()))


def invented(kind: str, end: str, _: Path) -> Measurements:
    return invent(kind, 30, end)


# Further layouts of rows, and who is fitted to them besides.
LAYOUTS = {
    **{f"{kind}, {end} stands": partial(invented, kind, end) for kind, end in INVENTED},
    "lobes, rx moves": lambda folder: lobes(folder, "rx")[0],
    "room": lambda _: room(40, directions=True)[0],
    "spectra, rx moves": lambda folder: own(spectra(folder / "own.npz", moving="rx")),
    "S": kinds.gains,
    "SK, tx moves": lambda folder: own(channels(folder / "own.npz", moving="tx", shape="SK")),
    "SAK": lambda folder: own(channels(folder / "own.npz")),
    "powers": kinds.received,
    "deaf": lambda _: deaf(city("all")),
    "bands": kinds.bands,
    "runs": lambda _: from_arrays(
        arrays(World("tone", 3, 1, "rx", "metres", "none", "random", 30), 0)
    ),
}
FITTED = [name for name in built_in_methods() if name != "calibrated_raytracer"]
CASES = [
    *((name, "") for name in (*FITTED, "ridge, all antennas")),
    *((name, f"{kind}, {end} stands") for name in (*PLAIN, "zero") for kind, end in INVENTED),
    *((name, "lobes, rx moves") for name in ("gsrf", "wrfgs", "swiftwrf", "nerf2")),
    ("gsrf", "room"),
    ("complex_gp", "runs"),
    ("image_source_gp", "bands"),
    *(("splat", layout) for layout in ("spectra, rx moves", "S", "SK, tx moves", "SAK", "powers")),
]


def own(file: Path) -> Measurements:
    return load({"name": "own", "file": str(file)})


def slow(cases: list[tuple[str, str]]) -> list[Any]:
    """Cases, marked where a fit takes more than a second that is not taken by others."""
    long = (*NAMED, "gsparc", "splat", "fire", "carriers", "ridge, all antennas")
    return [
        pytest.param(*case, marks=[pytest.mark.slow] if case[0] in long else []) for case in cases
    ]


@pytest.mark.parametrize(("name", "layout"), slow(CASES))
def test_answers_are_as_targets_in_any_order_and_those_of_the_stored(name, layout, tmp_path):
    """A file of its state alone says all, but for the sizes of what is trained."""
    method, data, fold = fitted(name, layout)
    batch, config = data.batch(fold.test), {}
    found = method.predict(batch)
    assert found.mean.shape == batch.target.shape and found.mean.dtype == batch.target.dtype
    assert name not in PLAIN or method.count_components() == len(fold.train) + len(fold.val)
    if name in SMALL:  # a file of when seconds ended fits is read too
        config = {"model": {"_target_": import_path(type(method)), **SMALL[name], "budget_s": 60.0}}
    checkpoint.save(tmp_path / "m.ckpt", method, yaml.safe_dump(config))
    again = loading.load(tmp_path / "m.ckpt")[0]
    assert name in UPLINK or again.count_components() == method.count_components()
    orders = fold.test, fold.test[::-1], fold.test[:1]
    whole, turned, one = (again.predict(data.batch(rows)) for rows in orders)
    if name in VARIANCE and not layout:
        assert found.variance.dtype == torch.float32 and (found.variance > 0).all()
        away = ends(method, places(method).float() + torch.tensor([1.0, 3, 30, 300, 3000])[:, None])
        torch.testing.assert_close(
            *(one.predict(away).variance for one in (method, again)), rtol=1e-5, atol=0
        )
    for part in ("mean", "confidence", "variance", "unknown", "explained"):
        values, stored = (getattr(said, part, None) for said in (found, whole))
        assert (values is None) == (stored is None), part
        if values is None:
            continue
        assert torch.isfinite(values).all()
        if part not in ("mean", "explained"):
            assert values.shape == (len(batch),) and (values >= 0).all()
            assert part == "variance" or (values <= 1).all()
        near = {"rtol": 1e-3, "atol": 1e-5 * float(values.abs().max())}
        torch.testing.assert_close(stored, values, **{**near, "rtol": 1e-5})
        torch.testing.assert_close(getattr(turned, part).flip(0), values, **near)
        torch.testing.assert_close(getattr(one, part), values[:1], **near)


REFUSED = [
    ("distance_law", "csi, rx stands", "distance_law: needs received powers"),
    ("ridge", "deaf", "has none"),
    ("array", "spectrum, rx stands", "no antenna array"),
    ("swiftwrf", "csi, rx stands", "swiftwrf: predicts .*holds csi"),
    ("gsrf", "powers", "gsrf: predicts .*holds rssi"),
    ("newrf", "csi, tx stands", "newrf: needs directions of arrival"),
    ("ngrf", "spectrum, rx stands", "ngrf: spectra need .* array"),
    *(
        (name, "powers", f"{name}: the target is rssi")
        for name in NAMED[:1] + NAMED[2:4] + NAMED[5:]
    ),
]


@pytest.mark.parametrize(("name", "layout", "says"), REFUSED)
def test_what_a_method_cannot_serve_is_refused_in_one_line(name, layout, says, tmp_path):
    data = LAYOUTS[layout](tmp_path)
    refused(
        says, lambda: unfitted(name).create_for(data).fit(data, fold_of(data), FitContext(tmp_path))
    )


UNFITTED = (*VARIANCE, "nearest", "splat", "gsrf", "uplink", "ridge")
POISONED = (*SMALL, *PLAIN, "complex_gp", "splat", "array", "directional_gp", "uplink")


@pytest.mark.parametrize("name", UNFITTED)
def test_a_method_that_is_not_fitted_says_so(name):
    query = Query(torch.zeros(1, 3), Pose.identity(torch.zeros(3)))
    with pytest.raises(
        ValueError, match=r"uplink= is needed|fit or restore|not fitted|not been trained"
    ):
        method_class(name)().predict(query)


@pytest.mark.parametrize("name", POISONED)
def test_no_test_row_is_looked_at(name, tmp_path):
    method, data, fold = fitted(name)
    batch, target, rays = data.batch(fold.test), data.target.copy(), data.directions
    target[fold.test] = 0 if target.dtype == np.uint8 else np.nan
    if rays is not None:
        rays = [
            np.full_like(one, np.nan) if row in fold.test else one for row, one in enumerate(rays)
        ]
    again = unfitted(name).create_for(data)
    again.fit(replace(data, target=target, directions=rays), fold, short(tmp_path, 10))
    assert torch.equal(again.predict(batch).mean, method.predict(batch).mean)


FEW = ("mean", "nearest", "idw", "gp", "kriging", "distance_law", "complex_gp", "array")


@pytest.mark.parametrize("rows", [1, 2, 3, "four at a place", "at one place", "alike"])
@pytest.mark.parametrize("name", FEW)
def test_few_rows_and_rows_of_one_place_are_finite(name, rows, tmp_path):
    _, data, fold = fitted(name)
    few, places = fold.train[: rows if isinstance(rows, int) else 20], np.zeros(len(data), int)
    if isinstance(rows, str):
        places = np.arange(len(data)) // 4 if rows == "four at a place" else places
        moving = "tx" if data.site.moving_end == "tx" else "rx_position"
        data = replace(data, **{moving: getattr(data, moving)[places]})
    if rows == "alike":
        data = replace(data, target=data.target[np.zeros(len(data), int)])
    method, batch = unfitted(name).create_for(data), data.batch(fold.test)
    method.fit(data, Fold(few, few[:0], fold.test), short(tmp_path, 10))
    found = method.predict(batch)
    assert all(
        torch.isfinite(part).all() for part in (found.mean, found.variance) if part is not None
    )
    assert (
        rows != "alike"
        or name == "array"
        or torch.allclose(found.mean, batch.target, rtol=1e-3, atol=0.02)
    )


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("gp", {"keep": 0.5, "confidence": False}),
        ("array", {"keep": 0.5}),
        ("moving_array", {"keep": 0.5}),
        ("gsparc", {"stride": 2, "confidence": False}),
    ],
)
def test_a_reduction_leaves_the_method_as_it_was(name, settings):
    method, data, fold = fitted(name)
    assert set(settings) <= set(method.reduction_settings())
    query = ends(method, places(method).float())
    before = method.predict(query)
    less = method.reduce(settings, method.reduction_inputs(data, fold.train))
    assert not torch.equal(less.predict(query).mean, before.mean)
    after = method.predict(query)
    for part in ("mean", "confidence", "variance"):
        one, two = getattr(before, part), getattr(after, part)
        assert (one is None and two is None) or torch.equal(one, two)


def served(predictor: Predictor, data: Measurements, rows: np.ndarray) -> torch.Tensor:
    """What a user is answered at the places of rows (n,), in stored units."""
    places = data.moving[rows] + data.site.origin
    ends = {data.site.moving_end: places}
    return ask(predictor, ends, linear=True).mean / data.site.target_scale


@pytest.mark.slow
@pytest.mark.parametrize(("name", "layout"), [case for case in CASES if case[1] != "runs"])
def test_what_is_scored_is_what_is_served(name, layout):
    """`answer` of rows and `predict` of places were two ways, each with code of its own."""
    method, data, fold = fitted(name, layout)
    rows, predictor = fold.test, Predictor(method, data.site)
    if data.station is not None:
        rows = rows[data.station[rows] == data.station[rows[0]]]
        predictor = predictor.select_station(int(data.station[rows[0]]))
    batch = data.batch(rows)
    scored = method.predict(batch).mean
    if name not in UPLINK:
        return torch.testing.assert_close(
            served(predictor, data, rows), scored, rtol=1e-4, atol=1e-5
        )
    refused("uplink= is needed", method.predict, replace(batch, uplink=None))
    heard = batch.uplink * data.site.target_scale
    said = predictor.csi(uplink=heard) / data.site.target_scale
    scored = method.predict(replace(batch, noise_variance=None)).mean
    # A search among sources of nearly the same use
    assert (said - scored).norm() < 1e-3 * scored.norm()


@pytest.mark.parametrize(
    ("name", "how"), [("gp", "each"), ("gp", "together"), ("gsparc", "together")]
)
def test_what_is_scored_of_stations_is_what_is_served(tmp_path, name, how):
    data = kinds.several(tmp_path)
    fold = fold_of(data)
    method = wrap_per_station(method_class(name)(), data)
    method.fit(data, fold, FitContext(tmp_path, stations=how))
    predictor = Predictor(method, data.site)
    for number in range(len(kinds.POSTS)):
        rows = fold.test[data.station[fold.test] == number]
        scored = method.predict(data.batch(rows)).mean
        torch.testing.assert_close(
            served(predictor.select_station(number), data, rows), scored, rtol=1e-4, atol=0
        )
        if how == "together":  # by the places of both ends, also where no station stands
            both = {"tx": data.moving[rows] + data.site.origin, "rx": kinds.POSTS[number]}
            level = predictor.rssi(**both, unit="linear")[:, 0] / data.site.target_scale
            np.testing.assert_allclose(level, scored[:, 0], rtol=1e-4)
            assert np.isfinite(predictor.rssi(**both | {"rx": kinds.POSTS[number] + 20})).all()


@pytest.mark.parametrize("words", ["model=complex_gp", "model=gsparc model.effects.phase=false"])
def test_places_are_served_in_the_phase_of_the_largest_run(words):
    data = from_arrays(arrays(World("tone", 3, 1, "rx", "metres", "none", "random", 30), 0))
    fold, method = fold_of(data), build(compose(*words.split()).model).create_for(data)
    method.fit(data, fold, FitContext())
    batch = data.batch(fold.test)
    factor = method.runs.look_up(batch.run)[:, None, None]
    assert (factor - 1).abs().max() > 0.1
    said = served(Predictor(method, data.site), data, fold.test)
    torch.testing.assert_close(
        said * factor.to(said.dtype), method.predict(batch).mean, rtol=1e-4, atol=1e-5
    )
    elsewhere = replace(batch, run=torch.full((len(batch),), 99))
    torch.testing.assert_close(said, method.predict(elsewhere).mean, rtol=1e-4, atol=1e-5)
