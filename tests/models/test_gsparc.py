"""The Gaussian field of every kind of measurement: what it says, keeps, stores,
and what it does not know.
"""

import logging
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
import torch
from campaigns import compose
from contexts import short
from kinds import KINDS
from omegaconf import OmegaConf
from scenes import fold_of

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import checkpoint, fitting, loading
from gsparc.models.gsparc import Gsparc
from gsparc.models.image_sources import ensemble
from gsparc.models.method import Method
from gsparc.models.mixture import fit_candidates
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import PerStation, wrap_per_station
from gsparc.models.registry import build, method_class
from gsparc.models.splat.image_process import ImageProcess
from gsparc.ops import Pose
from gsparc.training import race
from gsparc.training.context import FitContext, FitReport

SMALL = ("model.field.count=40", "init.searches=1", "init.search_rows=60", "init.max_sources=9")
BRIEF = 0.1  # effort

AWAY_M = 150.0
AWAY = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0.6, 0.6, 0.5]])


@dataclass(frozen=True)
class Fitted:
    """A field, what it learned from, and what it said."""

    method: Method
    data: Measurements
    fold: Fold
    report: FitReport
    config: str
    lines: tuple[str, ...]


class Kept(logging.Handler):
    """What was logged."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def fit(
    name: str,
    *overrides: str,
    effort: float = BRIEF,
    steps: int = 12,
    small: tuple[str, ...] = SMALL,
    **more: str,
) -> Fitted:
    folder, config = Path(mkdtemp()), compose(*small, *overrides)
    data = KINDS[name](folder)
    fold = fold_of(data)
    logger, kept = logging.getLogger("gsparc"), Kept()
    level = logger.level
    logger.addHandler(kept)
    logger.setLevel(logging.INFO)
    try:
        context = short(folder, steps, validate_every=4, effort=effort, **more)
        method, report = fitting.fit_or_resume(
            wrap_per_station(build(config.model), data), data, fold, context
        )
    finally:
        logger.removeHandler(kept)
        logger.setLevel(level)
    model = OmegaConf.create({"model": OmegaConf.to_container(config.model, resolve=True)})
    return Fitted(method, data, fold, report, OmegaConf.to_yaml(model), tuple(kept.lines))


@cache
def default(name: str) -> Fitted:
    """Fitted once."""
    return fit(name)


def asked(fitted: Fitted, count: int = 6):
    return fitted.data.batch(fitted.fold.test[:count])


def same(one: Method, two: Method, batch) -> None:
    for part in ("mean", "confidence", "variance"):
        a, b = getattr(one.predict(batch), part), getattr(two.predict(batch), part)
        assert (a is None) == (b is None), part
        if a is not None:
            torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6 * float(a.abs().max()))


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_every_kind_is_predicted_better_than_by_its_mean(name):
    fitted = default(name)
    batch = asked(fitted, 99)
    found, target = fitted.method.predict(batch).mean, batch.target
    assert found.shape == target.shape and found.dtype == target.dtype
    if fitted.data.site.kind == "rssi":
        found, target = 10 * found.log10(), 10 * target.log10()
    middle = torch.zeros(()) if target.is_complex() else target.mean(0)
    assert (found - target).abs().square().mean() < 0.8 * (target - middle).abs().square().mean()


@pytest.mark.parametrize("name", KINDS)
def test_a_checkpoint_says_the_same(name, tmp_path):
    fitted = default(name)
    checkpoint.save(tmp_path / "model.ckpt", fitted.method, fitted.config)
    again, _ = loading.load(tmp_path / "model.ckpt")
    same(fitted.method, again, asked(fitted))
    assert again.count_components() == fitted.method.count_components()
    assert again.effects == fitted.method.effects


NAMED = {
    "images": "image_process",
    "static array": "array_process",
    "moving array": "bearings",
    "channels": "image_sources",
    "channels from nowhere known": "channels",
    "powers": "powers",
}


@pytest.mark.parametrize("name", NAMED)
def test_what_is_chosen_is_named(name):
    assert f"gsparc is model={NAMED[name]} here" in default(name).lines


@pytest.mark.slow
@pytest.mark.parametrize("name", ["images", "channels from nowhere known", "powers"])
def test_what_is_chosen_answers_the_same_by_its_own_name(name):
    count = ("model.field.count=40",) if name == "images" else ()
    both = [
        fit(name, f"model={model}", *count, small=(), effort=1.0)
        for model in ("gsparc", NAMED[name])
    ]
    facts = [one.method.facts() | {"model/made": "", "time/init_s": None} for one in both]
    assert facts[0] == facts[1]
    same(both[0].method, both[1].method, asked(both[0]))


@pytest.mark.parametrize("name", KINDS)
def test_far_from_all_data_nothing_is_known(name):
    fitted = default(name)
    batch, site = asked(fitted), fitted.data.site
    far = torch.from_numpy(site.box.mean(0)).float() + AWAY_M * AWAY[: len(batch)]
    there = (
        replace(batch, tx=far)
        if site.moving_end == "tx"
        else replace(batch, rx=Pose(far, batch.rx.rotation))
    )
    near, away = fitted.method.predict(batch).confidence, fitted.method.predict(there).confidence
    assert ((near >= 0) & (near <= 1)).all() and (away < 0.01).all() and near.mean() > 0.2


@pytest.mark.parametrize("name", KINDS)
def test_facts_say_where_it_started_and_what_that_cost(name):
    fitted = default(name)
    facts = fitted.method.facts()
    assert {*facts} == {
        "model/init",
        "model/steps",
        "model/variance_explained",
        "model/num_gaussians",
        "time/init_s",
        "model/made",
        "model/class",
        "model/choices",
        "model/steps_taken",
    }
    assert facts["model/init"] and facts["model/init"] != "auto"
    assert facts["model/num_gaussians"] == fitted.method.count_components()
    assert facts["model/steps"] >= 0 and 0 < facts["time/init_s"] <= fitted.report.seconds
    share = facts["model/variance_explained"]
    assert share is None or share <= 1


@pytest.mark.parametrize("name", [name for name in KINDS if "stations" not in name])
def test_the_log_begins_with_what_is_trained_and_ends_with_what_it_cost(name):
    fitted = default(name)
    first = next(line for line in fitted.lines if line.startswith("training "))
    before = fitted.lines[: fitted.lines.index(first)]
    assert all(
        line.startswith(("effects.", "the residual is all there is")) for line in before[:-1]
    )
    assert before[-1].startswith("gsparc is model=")
    init = "+".join(part for part in first.partition("init=")[2].split(",")[:1])
    assert ("by rendering" in first) == isinstance(fitted.method, ImageProcess) and init
    assert ("callbacks" in first) == ("by rendering" in first)
    last = fitted.lines[-1]
    assert last.startswith("cost: ")
    # After the fit
    spent = fitted.report.seconds - fitted.report.cost.stages.get("rows left out", 0.0)
    assert f" {spent:.1f} s in all" in last or " s spent on what is not used" in last


@pytest.mark.slow
def test_channels_are_a_mean_of_fields_that_is_stored_whole(monkeypatch, tmp_path):
    equal = lambda gram, *unused, **named: np.full(gram.shape[1], 1 / gram.shape[1])  # noqa: E731
    monkeypatch.setattr(fit_candidates, "weigh", equal)
    monkeypatch.setattr(race, "LEAST_GAIN", -math.inf)
    monkeypatch.setattr(ensemble, "CONVERGED_ERROR", 0.0)
    few = ("init.searches=2", "init.search_rows=64", "init.max_sources=8")
    fitted = fit("channels", *few, effort=1.0)
    field = fitted.method
    assert sum(field.weights) == pytest.approx(1)
    assert fitted.method.facts()["model/init"] == "diffuse+sources" and field.count_gaussians
    assert {"phase", "residual"} <= set(fitted.method.effects.split("+"))
    checkpoint.save(tmp_path / "model.ckpt", fitted.method, fitted.config)
    again, _ = loading.load(tmp_path / "model.ckpt")
    same(fitted.method, again, asked(fitted))
    assert again.weights == field.weights
    rows = np.sort(np.concatenate([fitted.fold.train, fitted.fold.val]))
    again.condition(fitted.data, rows)  # the same rows, the same weights
    batch = asked(fitted)
    one, two = (m.predict(batch).mean for m in (fitted.method, again))
    torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-3 * float(one.abs().max()))


def test_a_search_that_could_gain_too_little_ends(monkeypatch, caplog):
    monkeypatch.setattr(race, "LEAST_GAIN", math.inf)
    monkeypatch.setattr(race, "STALLED", -math.inf)
    fitted = fit("channels", effort=1.0)
    assert "init=sources is left out: " in caplog.text
    assert (
        fitted.method.facts()["model/init"] == "diffuse" and "sources" in fitted.report.cost.unused
    )


@pytest.mark.parametrize(
    "name,plain",
    [
        ("images", "gp"),
        ("static array", "gp"),
        ("moving array", "gp"),
        ("powers", None),
        ("channels", None),
        ("channels of an array", None),
    ],
)
def test_without_gaussians_it_is_the_plain_process(name, plain):
    fitted = fit(name, "model.field.count=0", "model.steps=0")
    assert fitted.method.count_components() == 0 and "phase" not in fitted.method.effects
    assert fitted.method.facts()["model/variance_explained"] is None
    if plain is not None:
        process, known = (
            method_class(plain)(),
            np.sort(np.concatenate([fitted.fold.train, fitted.fold.val])),
        )
        process.fit(
            fitted.data, Fold(known, known[:0], fitted.fold.test), short(Path(mkdtemp()), 1)
        )
        batch = asked(fitted)
        one, two = fitted.method.predict(batch), process.predict(batch)
        torch.testing.assert_close(one.mean, two.mean, rtol=1e-4, atol=0)
        torch.testing.assert_close(one.confidence, two.confidence, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["static array", "channels"])
def test_without_the_residual_gaussians_are_alone(name):
    fitted = fit(name, "model.effects.residual=false")
    method = fitted.method
    assert "residual" not in method.effects and method.count_components() > 0
    if isinstance(method, ImageProcess):
        assert method.state()["beside"] is None
        return
    batch = asked(fitted)
    found = method.predict(batch)
    torch.testing.assert_close(found.mean, found.explained)


def test_stations_have_fields_of_their_own():
    fitted = fit("powers of several stations", stations="each")
    assert isinstance(fitted.method, PerStation) and fitted.method.effects == "residual"
    assert all(isinstance(copy, Powers) for _, copy in fitted.method)
    assert sum("init=powers" in line for line in fitted.lines if line.startswith("training ")) == 2


def test_weights_to_start_from_were_ignored_in_closed_form(tmp_path):
    data = KINDS["powers"](tmp_path)
    context = FitContext(init_from=tmp_path / "model.ckpt")
    with pytest.raises(ValueError, match="init_from: gsparc takes no weights to start from here"):
        fitting.fit_or_resume(Gsparc(), data, fold_of(data), context)
