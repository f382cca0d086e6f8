"""`model=auto` takes what errs least on rows left out as the test's are, and keeps to its seconds."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from campaigns import compose, powers, spectra
from clocks import wound
from contexts import short
from invented import invent
from kinds import KINDS

from gsparc.auto.auto_method import Auto
from gsparc.commands.train import train
from gsparc.data.load import load, split_for, split_settings
from gsparc.data.own import from_arrays
from gsparc.data.splits import Fold, make_split
from gsparc.evaluation.console import one_line
from gsparc.evaluation.scores import score
from gsparc.methods import checkpoint
from gsparc.methods.method import FitContext, FitReport, HasGaussians, Method, Prediction
from gsparc.methods.per_station import PerStation, for_links
from gsparc.methods.registry import build, method_class

POST = np.array([12.0, 5.0, 3.0])
CUTS = {"random": {"name": "random"}, "blocks": {"name": "blocks", "side_m": 4.0}}


def street(rows: int = 300, seed: int = 0):
    """A distance law with shadowing: near a measurement that tells more, far from all the law does."""
    rng = np.random.default_rng(seed)
    walk = rng.uniform([0, 0, 1], [10, 10, 1.1], (rows, 3))
    apart = np.linalg.norm(walk[:, None] - walk, axis=-1)
    shadow = np.linalg.cholesky(np.exp(-(apart**2)) + 1e-6 * np.eye(rows)) @ rng.normal(size=rows)
    far = np.linalg.norm(walk - POST, axis=1)
    arrays = {"tx_position": walk, "rx_position": POST, "rssi_db": -40 * np.log10(far) + 4 * shadow}
    return from_arrays(arrays, {"name": "street"})


class Known(Method):
    """The true target with errors of its own at every place, drawn with `seed`."""

    def __init__(self, name: str, deviation: float, seed: int, seconds: float = 0.0) -> None:
        self.name, self.deviation, self.seed, self.takes_budget = name, deviation, seed, seconds > 0
        self.seconds, self.fits, self.said = seconds, [], None

    def fit(self, data, fold, context):
        self.fits.append((len(fold.train) + len(fold.val), context.budget_s))
        self.site, self.data = data.site, data
        return FitReport(0.0)

    def predict(self, tx, rx):
        where = np.abs(self.data.tx[None] - tx.numpy()[:, None]).sum(-1).argmin(1)
        noise = np.random.default_rng(self.seed).normal(size=len(self.data))[where] * self.deviation
        return Prediction(self.data.targets(where) * torch.from_numpy(10 ** (noise / 10)).float()[:, None])

    def state(self):
        return {}

    def restore(self, site, state):
        self.site = site


class Shared(Known):
    """One object for all trials, so that its fits can be counted."""

    def __deepcopy__(self, memo):
        return self


def fitted(method, data, tmp_path, cut="random", **context):
    settings = split_settings(CUTS[cut])
    fold = split_for(CUTS[cut], data).folds[0]
    report = method.fit(data, fold, FitContext(tmp_path, split=settings, **context))
    return fold, report


def rmse(method, data, fold):
    split = make_split(data.moving, split_settings(CUTS["random"]))
    return score([method], data, type(split)("x", (fold,), "")).figures()["rmse_db"]


@pytest.mark.parametrize("cut,best", [("random", "idw"), ("blocks", "distance_law")])
def test_what_is_chosen_is_the_better_one_of_that_cut(cut, best, tmp_path):
    """Among neighbours interpolation is better, in squares without any the law is."""
    data, names = street(), ("distance_law", "idw")
    method = Auto(names)
    fold, _ = fitted(method, data, tmp_path, cut)
    assert max(method.members, key=lambda m: m.weight).name == best
    alone = {}
    for name in names:
        alone[name] = method_class(name)()
        alone[name].fit(data, fold, FitContext(tmp_path))
    errors = {name: rmse(one, data, fold) for name, one in alone.items()}
    assert min(errors, key=errors.get) == best
    assert rmse(method, data, fold) < 1.05 * errors[best]


def test_a_mixture_is_taken_where_it_pays_and_the_table_says_so(tmp_path, caplog):
    caplog.set_level(logging.INFO, "gsparc")
    method = Auto([Known("one", 2.0, 0), Known("other", 2.0, 1)])
    data = street(200)
    fold, report = fitted(method, data, tmp_path)
    assert [m.weight for m in method.members] == pytest.approx([0.5, 0.5], abs=0.15)
    assert method.label.startswith("auto (") and " + " in method.label and method.name == "auto"
    assert rmse(method, data, fold) < 1.7
    said = [record.getMessage() for record in caplog.records if record.name.startswith("gsparc.auto")]
    assert [line.split(": ")[1] for line in said[:2]] == ["one", "other"] and "rmse" in said[0]
    assert len(said) == 3 and said[2] == report.notes[0] and method.label in said[2]
    found = method.predict(*_ends(data, fold.test))
    variance = (found.variance.sqrt() / found.mean[:, 0]) * 10 / np.log(10)  # in decibels
    assert float(variance.mean()) == pytest.approx(1.4, rel=0.2)


def test_one_alone_is_taken_where_no_mixture_pays(tmp_path):
    one = Known("one", 2.0, 0)
    same = Known("same", 2.05, 0)  # errs as the first does
    method = Auto([same, one])
    fitted(method, street(150), tmp_path)
    assert method.label == "auto (one)" and len(method.members) == 1


def test_a_hopeless_candidate_is_given_up_after_one_fold(tmp_path):
    good, bad = Shared("good", 1.0, 0), Shared("bad", 15.0, 1)
    method = Auto([good, bad])
    fold, _ = fitted(method, street(150), tmp_path)
    assert len(good.fits) == 6 and len(bad.fits) == 1  # five folds and all rows
    assert method.label == "auto (good)"
    assert good.fits[-1][0] == len(fold.train) + len(fold.val)
    assert max(rows for rows, _ in good.fits[:-1]) < good.fits[-1][0]


def test_a_clear_winner_has_the_seconds_of_further_folds(tmp_path, monkeypatch, caplog):
    clock = wound(monkeypatch).monotonic

    class Timed(Shared):
        def fit(self, data, fold, context):
            clock.wind(context.budget_s)
            return super().fit(data, fold, context)

    slow, quick = Timed("slow", 1.0, 0, 1.0), Shared("quick", 15.0, 1)
    with caplog.at_level("INFO", logger="gsparc.auto"):
        fitted(Auto([slow, quick], budget_s=60.0), street(150), tmp_path)
    assert len(slow.fits) == 2 and slow.fits[1][1] > 2 * slow.fits[0][1]
    assert "slow: clearly better than all others" in caplog.text


def test_what_ignores_its_seconds_is_kept_as_its_trial_left_it(tmp_path, monkeypatch):
    clock = wound(monkeypatch).monotonic

    class Endless(Shared):
        def fit(self, data, fold, context):
            clock.wind(40.0)
            return super().fit(data, fold, context)

    endless = Endless("endless", 1.0, 0, 1.0)
    before = clock.now
    _, report = fitted(Auto([endless, Shared("quick", 9.0, 1)], budget_s=45.0), street(150), tmp_path)
    assert len(endless.fits) == 1 and clock.now - before < 49.5
    assert any("no seconds were left" in note for note in report.notes)


@pytest.mark.parametrize("given", [None, 30.0])
def test_the_budget_is_kept_and_the_rest_goes_to_the_last_fit(given, tmp_path, monkeypatch):
    clock = wound(monkeypatch).monotonic

    class Timed(Shared):
        def fit(self, data, fold, context):
            report = super().fit(data, fold, context)
            clock.wind(context.budget_s or self.seconds)
            return report

    slow, other, quick = Timed("slow", 1.0, 0, 1.0), Timed("other", 1.1, 1, 1.0), Timed("quick", 3.0, 2)
    quick.seconds = 0.5
    method = Auto([slow, other, quick], budget_s=60.0)
    before = clock.now
    _, report = fitted(method, street(150), tmp_path, budget_s=given)
    wanted = given or 60.0
    assert 0.85 * wanted < clock.now - before < 1.1 * wanted
    assert report.limited_by == "wall" and method.own_budget_s == 60.0
    assert quick.fits[0][1] is None and len(quick.fits) >= 3  # first, and in the seconds that it needs
    assert len(slow.fits) == 4 and slow.fits[-1][1] >= slow.fits[0][1] - 0.1


def test_a_candidate_that_ignores_its_seconds_is_compared_on_what_it_came_to(tmp_path, monkeypatch):
    clock = wound(monkeypatch).monotonic

    class Endless(Shared):
        def fit(self, data, fold, context):
            clock.wind(14.0)
            return super().fit(data, fold, context)

    endless, quick = Endless("endless", 1.0, 0, 1.0), Shared("quick", 1.3, 1)
    method = Auto([endless, quick], budget_s=45.0)
    before = clock.now
    _, report = fitted(method, street(150), tmp_path)
    assert len(endless.fits) == 3 and "endless" in method.label  # two folds, and all rows
    assert "(2 folds" in report.notes[0] and clock.now - before < 49.5


def test_what_does_not_serve_the_data_is_left_out_in_one_line(tmp_path, caplog):
    caplog.set_level(logging.INFO, "gsparc")
    data = load({"name": "own", "file": str(spectra(tmp_path / "s.npz", 60))})
    method = Auto(["distance_law", "complex_gp", "idw", "gp", "uplink"])
    fold, _ = fitted(method, data, tmp_path)
    lines = [r.getMessage() for r in caplog.records if "not for these data" in r.getMessage()]
    assert lines == ["auto: not for these data: distance_law, complex_gp, uplink"]
    found = method.answer(data.batch(fold.test))
    assert found.mean.shape == (len(fold.test), 16, 32) and found.variance.shape == (len(fold.test),)
    with pytest.raises(ValueError, match=r"auto: no candidate serves these data .*powers") as raised:
        fitted(Auto(["distance_law", "uplink"]), data, tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_a_checkpoint_predicts_the_same(kind, tmp_path):
    data = invent(kind, 60)
    method = Auto(["idw", "gp", "kriging"])
    fold, _ = fitted(method, data, tmp_path)
    config = "model: {_target_: gsparc.auto.auto_method.Auto, candidates: [idw, gp, kriging]}"
    for text in ("", config):
        checkpoint.save(tmp_path / "model.ckpt", method, text)
        again, _ = checkpoint.load(tmp_path / "model.ckpt")
        assert again.label == method.label and again.size() == method.size()
        asked = _ends(data, fold.test)
        one, two = method.predict(*asked), again.predict(*asked)
        for part in ("mean", "confidence", "variance"):
            torch.testing.assert_close(getattr(one, part), getattr(two, part))
        assert one.mean.dtype == data.targets(fold.test).dtype


def test_every_station_chooses_for_itself_within_the_seconds_of_all(tmp_path):
    walk = np.random.default_rng(0).uniform([0, 0, 1], [20, 20, 2], (60, 3))
    posts = np.array([[0.0, 0, 5], [20, 0, 5], [0, 20, 5]])
    far = np.linalg.norm(walk[:, None] - posts, axis=-1)
    arrays = {"tx_position": walk, "station_position": posts, "rssi_db": -20 * np.log10(far)}
    data = from_arrays(arrays)
    settings = split_settings({"name": "stations"})
    split = make_split(data.moving, settings, place=data.place, station=data.station)
    method = for_links(lambda: Auto(["distance_law", "idw", "mean"]), data)
    method.fit(data, split.folds[0], FitContext(tmp_path, split=settings))
    assert isinstance(method, PerStation) and method.name == "auto"
    assert method.label == "auto (distance_law)"
    found = method.answer(data.batch(split.folds[0].test)).mean
    assert torch.allclose(found, data.targets(split.folds[0].test), rtol=0.1)
    checkpoint.save(tmp_path / "model.ckpt", method)
    again, _ = checkpoint.load(tmp_path / "model.ckpt")
    assert torch.allclose(again.answer(data.batch(split.folds[0].test)).mean, found)


def test_the_seconds_are_those_of_all_stations(tmp_path):
    walk = np.random.default_rng(0).uniform([0, 0, 1], [20, 20, 2], (40, 3))
    posts = np.array([[0.0, 0, 5], [20, 0, 5], [0, 20, 5]])
    far = np.linalg.norm(walk[:, None] - posts, axis=-1)
    arrays = {"tx_position": walk, "station_position": posts, "rssi_db": -20 * np.log10(far)}
    data, timed = from_arrays(arrays), Shared("timed", 1.0, 0, 1.0)
    fold = make_split(data.moving, split_settings(CUTS["random"]), place=data.place).folds[0]
    for_links(lambda: Auto([timed], budget_s=60.0), data).fit(data, fold, FitContext(tmp_path))
    assert len(timed.fits) == 3 * 4 and all(0 < seconds < 20 for _, seconds in timed.fits[:4])
    assert all(0 < seconds < 60 for _, seconds in timed.fits)  # what one station leaves is the next one's


def test_seconds_are_shared_by_those_that_serve_the_data(tmp_path, caplog):
    """`moving_array` and `image_source_gp` took two thirds of the seconds of powers, for nothing."""
    caplog.set_level(logging.INFO, "gsparc.auto")
    timed = Shared("timed", 1.0, 0, 1.0)
    method = Auto([timed, "moving_array", "image_source_gp"], budget_s=60.0)
    fitted(method, street(60), tmp_path)
    assert timed.fits[0][1] > 60 / 3 / 2  # three folds, all rows, and as much in reserve
    assert "not for these data: moving_array, image_source_gp" in caplog.text
    assert "auto: timed: fold 1 of 3, about" in caplog.text and "are left in all" in caplog.text


@pytest.mark.parametrize("kind", ["powers", "channels", "images"])
def test_the_field_is_a_candidate_that_is_stored(kind, tmp_path):
    data = KINDS[kind](tmp_path)
    method = Auto(["mean", "gsparc"], budget_s=6.0)
    fold = split_for(CUTS["random"], data).folds[0]
    context = short(tmp_path, 20, validate_every=10, split=split_settings(CUTS["random"]))
    report = method.fit(data, fold, context)
    assert report.seconds < 12 and method.label.startswith("auto (") and "gsparc" in method.label
    assert method.facts()["model/num_gaussians"] is not None and method.facts()["model/init"]
    checkpoint.save(tmp_path / "model.ckpt", method)
    again, _ = checkpoint.load(tmp_path / "model.ckpt")
    batch = data.batch(fold.test)
    torch.testing.assert_close(again.answer(batch).mean, method.answer(batch).mean)
    assert again.label == method.label and again.size() == method.size()
    assert isinstance(again, HasGaussians)
    if kind == "images":
        (rendered,) = (one for one in method._fitted if one.has_gaussians)
        assert len(again.gaussians(batch.tx, batch.rx)) == rendered.size()


def test_what_holds_no_gaussians_says_so(tmp_path):
    data = street(60)
    method = Auto(["mean"])
    fold, _ = fitted(method, data, tmp_path)
    with pytest.raises(ValueError, match=r"auto \(mean\): nothing here is rendered"):
        method.gaussians(*_ends(data, fold.test))


def test_an_interrupt_is_not_swallowed(tmp_path):
    class Interrupted(Known):
        def fit(self, data, fold, context):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="interrupted while it tried one; there is no checkpoint"):
        fitted(Auto([Interrupted("one", 1.0, 0)]), street(60), tmp_path)


def test_too_few_rows_to_leave_any_out_are_refused_in_a_line(tmp_path):
    data, none = street(60), np.zeros(0, np.int64)
    with pytest.raises(ValueError, match="1 training places are too few"):
        Auto(["idw"]).fit(data, Fold(np.arange(1), none, np.arange(3, 9)), FitContext(tmp_path))


@pytest.mark.parametrize(
    "override,hint",
    [
        (
            "model.candidates=[gp,kirging]",
            "model.candidates: no model is called 'kirging'; did you mean 'kriging'",
        ),
        ("model.candidates=[gp,gp]", "model.candidates: gp is named twice"),
        ("model.candidates=[]", "model.candidates=[]: at least one model is needed"),
        ("model.budget_s=0", "model.budget_s=0: a number above 0 is needed"),
        ("model.folds=1", "model.folds=1: a whole number of at least 2, or null is needed"),
    ],
)
def test_wrong_settings_are_a_line(override, hint):
    with pytest.raises(Exception) as raised:
        build(compose("model=auto", override).model)
    assert one_line(raised.value).startswith(hint)


def test_candidates_of_the_command_line_are_cut_as_the_run_is(tmp_path, caplog):
    caplog.set_level(logging.INFO, "gsparc")
    file = powers(tmp_path / "own.npz")
    config = compose(
        "model=auto", "model.candidates=[gp,idw]", "model.models.gp.components=7", "dataset=own",
        f"dataset.file='{file}'", "split=blocks", "split.side_m=1", "baselines=[mean]", "logger=none",
    )  # fmt: skip
    facts, objects = train(config, tmp_path)
    method = objects.methods[0]
    assert f"{method.label}: rmse" in caplog.text and "split=blocks" in caplog.text
    assert facts["model/name"] == "auto" and facts["model/label"] == method.label
    assert {m.name for m in method.members} <= {"gp", "idw"} and method.label in objects.methods[0].label
    assert checkpoint.load(objects.checkpoints[0])[0].label == method.label


def _ends(data, rows):
    batch = data.batch(rows)
    return batch.tx, batch.rx
