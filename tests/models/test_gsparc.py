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
from gsparc.models import fitting
from gsparc.models.gsparc import Gsparc
from gsparc.models.method import Method
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import PerStation, wrap_per_station
from gsparc.models.registry import build, method_class
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
