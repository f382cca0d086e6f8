"""`locate`: places from values in the units and shapes of predictions."""

import logging
import shutil
from dataclasses import asdict

import numpy as np
import pytest
import torch
import towns
from campaigns import spectra
from refusals import refused

import gsparc
from gsparc.apps.locate import locate
from gsparc.apps.locate.search import Trust
from gsparc.apps.locate.snapshots import SiteField
from gsparc.models import checkpoint
from gsparc.models.predicting import predict_with_threads


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return towns.trained(spectra(tmp_path_factory.mktemp("located") / "own.npz", rows=80), "gp")


def calibrated(**trust):
    """As `gsparc locate` stored it before it kept the prior, the plan and the cells, too."""
    before = {"unknown": {"phase_known": False, "offset_db": 0.0}, "share": 0.9}
    return {"locate": {"trust": asdict(Trust(**trust)), **before}}


def test_a_predicted_spectrum_is_located_where_it_was_predicted(trained):
    predictor = gsparc.load(trained)
    low, high = predictor.site.moving_box + predictor.site.origin
    places = low + (high - low) * np.array([[0.3, 0.4, 0.5], [0.7, 0.5, 0.4]])
    found = locate(predictor, predictor.spectrum(tx=places))
    assert np.linalg.norm([one.place for one in found] - places, axis=1).max() < 0.1
    corner = locate(
        predictor, predictor.spectrum(tx=places[:1]), where=low[None] + [[0, 0, 0], [0.3, 0.3, 0.1]]
    )
    assert (corner[0].place <= low + 0.61).all(), "nowhere else can one stand"


def test_areas_are_those_that_were_calibrated(trained, caplog):
    predictor = gsparc.load(trained)
    spectrum = predictor.spectrum(
        tx=(predictor.site.moving_box + predictor.site.origin).mean(0)[None]
    )
    with caplog.at_level(logging.WARNING):
        before = locate(predictor, spectrum)[0]
    assert "not calibrated" in caplog.text
    checkpoint.update_extra(trained, calibrated(spread=0.2))
    after = locate(gsparc.load(trained), spectrum)[0]
    assert after.area > 2 * before.area
    refused(r"was calibrated with share=0\.9", locate, gsparc.load(trained), spectrum, share=0.5)


def test_a_calibration_of_another_prior_was_taken_unsaid(trained, tmp_path, caplog):
    path = shutil.copy(trained, tmp_path / "model.ckpt")
    how = {"share": 0.9, "phase_known": False, "offset_db": 0.0, "prior": "box", "plan": None}
    checkpoint.update_extra(path, {"locate": {"trust": asdict(Trust()), "how": how}})
    predictor = gsparc.load(path)
    middle = (predictor.site.moving_box + predictor.site.origin).mean(0)[None]
    for where, said in ((None, False), (middle + np.diag([0.3, 0.3, 0.1]), True)):
        locate(predictor, predictor.spectrum(tx=middle), where=where)
        assert ("calibrated with prior=box, plan=None, not here" in caplog.text) == said


def test_a_snapshot_unlike_all_that_were_left_out_had_an_area_as_any_other(trained, tmp_path):
    path = shutil.copy(trained, tmp_path / "model.ckpt")
    checkpoint.update_extra(path, calibrated(worst=2.0))
    predictor = gsparc.load(path)
    like = predictor.spectrum(tx=(predictor.site.moving_box + predictor.site.origin).mean(0)[None])
    unlike = np.roll(np.asarray(like), like.shape[-1] // 2, -1)[..., ::-1, :].copy()
    assert [bool(one.doubt) for one in locate(predictor, np.concatenate([like, unlike]))] == [
        False,
        True,
    ]


def test_the_larger_box_was_asked_about_again_by_each_call(trained, tmp_path, monkeypatch):
    path = shutil.copy(trained, tmp_path / "model.ckpt")
    checkpoint.update_extra(path, calibrated(worst=0.0))
    predictor, asked, moments = gsparc.load(path), [], SiteField.moments_at
    spectrum = predictor.spectrum(
        tx=(predictor.site.moving_box + predictor.site.origin).mean(0)[None]
    )
    counted = lambda field, places: asked.append(len(places)) or moments(field, places)  # noqa: E731
    monkeypatch.setattr(SiteField, "moments_at", counted)
    for _ in range(2):
        locate(predictor, spectrum)
    assert sum(count > 1_000 for count in asked) == 2, "the coarse grids of both boxes, once each"


def test_stations_at_one_place_were_asked_in_different_parts(tmp_path, monkeypatch):
    """What 42 antennas share of a place was computed for each part: 2 times as long."""
    predictor, rows = gsparc.load(towns.town_model()), []
    counted = lambda by, query: rows.append(len(query)) or predict_with_threads(by, query)  # noqa: E731
    monkeypatch.setattr("gsparc.apps.locate.snapshots.predict_with_threads", counted)
    monkeypatch.setattr("gsparc.apps.locate.snapshots.CHUNK", 9)
    SiteField(predictor).moments_at(
        torch.from_numpy(np.tile(predictor.site.moving_box[:1, :3], (7, 1)))
    )
    assert rows == [8, 6], "of two stations"


@pytest.mark.parametrize(
    "values, more, said",
    [
        (np.zeros((2, 3)), {}, r"values \(2, 3\) torch.float64 are no spectrum"),
        (np.zeros((1, 9, 36), complex), {}, "are no spectrum"),
        (np.full((1, 9, 36), np.nan), {}, "in which nothing was heard"),
        (np.zeros((1, 9, 36)), {"silent": [[True]]}, "silent"),
    ],
)
def test_values_of_another_kind_are_refused_in_one_line(trained, values, more, said):
    refused(said, locate, gsparc.load(trained), values, **more)
