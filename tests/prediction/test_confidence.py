"""A confidence kept with a model, and what `gsparc.load` answers with it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from towns import trained

import gsparc
from gsparc.models import checkpoint, loading
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.prediction.confidence import (
    Guarantee,
    Trusted,
    as_confidence,
    calibrated_box,
    store_trusted,
)
from gsparc.prediction.left_out import gather_evidence
from gsparc.runs.unseen import Unseen
from gsparc.training.context import FitContext


@pytest.fixture
def site(campaign, folds, tmp_path):
    data, fold = campaign("spectrum", 60), folds(60).folds[0]
    method = GaussianProcess()
    method.fit(data, fold, FitContext(tmp_path))
    file = tmp_path / "gp.ckpt"
    checkpoint.save(file, method)
    return data, fold, file


def test_every_kind_orders_positions_as_the_evidence_does(site) -> None:
    data, fold, file = site
    method, _ = loading.load(file)
    evidence = gather_evidence(method, data, fold.test)
    store_trusted(file, Trusted("expected", 0.2, Guarantee()))
    world = data.tx[fold.test] + data.site.origin
    for kind, score in evidence.scores.items():
        answered = gsparc.load(file, confidence=kind).confidence(tx=world)
        assert answered.dtype == np.float32 and ((answered >= 0) & (answered <= 1)).all()
        assert np.allclose(answered, as_confidence(kind, score), atol=1e-3)
    plain = gsparc.load(file)
    expected = as_confidence("expected", evidence.scores["expected"])
    assert np.allclose(plain.confidence(tx=world), expected, atol=1e-3)
    assert np.array_equal(plain.accepts(tx=world), plain.confidence(tx=world) >= 0.2)
    assert isinstance(plain.accepts(tx=world[0]), bool)
    # It listed every place that was learned from.
    said = r"Trusted\(kind='expected', threshold=0.2, promise=Guarantee\([^()]+\)\)"
    assert re.fullmatch(said, repr(plain.trusted))


def test_a_share_above_one_was_promised() -> None:
    refused("above 0 and below 1", Guarantee, alpha=1.5)


def test_two_moving_ends_are_accepted_where_both_were_measured(tmp_path) -> None:
    rng = np.random.default_rng(0)
    ends = [np.column_stack([rng.uniform(0, 20, (60, 2)), np.full(60, 1.5)]) for _ in range(2)]
    loss = -30 - 25 * np.log10(np.linalg.norm(ends[0] - ends[1], axis=1) + 1)
    np.savez(tmp_path / "ends.npz", tx_position=ends[0], rx_position=ends[1], rssi_db=loss)
    path = trained(tmp_path / "ends.npz", "gp", "split.test_fraction=0.5")
    trusted, _ = Unseen.open(str(path), {}, {}).calibrate_and_store(
        Guarantee(0.0, 0.3, 0.2), "auto", False, 0
    )
    assert trusted.box.shape == (2, 6)
    near, far, place = [5.0, 5, 1.5], [40.0, 10, 1.5], [10.0, 10, 1.5]
    accepted = gsparc.load(path).accepts(tx=[near, far, near], rx=[place, place, far])
    assert accepted.tolist() == [True, False, False]


def test_what_was_never_stored_is_said(site) -> None:
    data, fold, file = site
    world = data.tx[fold.test[:2]] + data.site.origin
    refused("no threshold is stored", gsparc.load(file).accepts, tx=world)
    refused("expected one of expected, learned", gsparc.load, file, confidence="hope")
    store_trusted(file, Trusted("learned", 0.5, Guarantee()))
    with pytest.raises(ValueError, match="threshold is one of confidence=learned"):
        gsparc.load(file, confidence="expected").accepts(tx=world)


def test_a_confidence_of_before_is_the_models_own_and_said(site, caplog) -> None:
    """Checkpoints held distances, and the places that these are from."""
    data, _, file = site
    store_trusted(file, Trusted("expected", 0.2, Guarantee()))
    extra = checkpoint.read(file).extra
    extra["confidence"]["state"] |= {"kind": "distance", "known": [], "kernel": None}
    checkpoint.update_extra(file, extra)
    predictor = gsparc.load(file)
    assert "confidence=distance" in caplog.text and "gsparc calibrate" in caplog.text
    refused("no threshold is stored", predictor.accepts, tx=data.tx[:1] + data.site.origin)
    extra["confidence"]["state"]["kind"] = "expected"
    checkpoint.update_extra(file, extra)
    assert gsparc.load(file).trusted == Trusted("expected", 0.2, Guarantee())


def test_a_place_outside_of_all_measurements_was_accepted(site) -> None:
    """A model that found sources is sure 30 m beyond its room."""
    data, fold, file = site
    trusted = Trusted("learned", 0.0, Guarantee())
    near = data.tx[fold.train[:2]] + data.site.origin
    places = np.concatenate([near, near + np.array([30.0, 0, 0])])
    store_trusted(file, trusted)
    assert gsparc.load(file).accepts(tx=places).all()  # as files of before
    store_trusted(file, replace(trusted, box=calibrated_box(data.moving[fold.learned()])))
    assert gsparc.load(file).accepts(tx=places).tolist() == [True, True, False, False]


def test_thresholds_that_failed_in_trials_were_accepted_without_a_word(site, caplog) -> None:
    """The console said `no promise`, and a program that asked `accepts` never heard of it."""
    data, fold, file = site
    store_trusted(file, Trusted("learned", 0.0, Guarantee(), failed=0.26))
    predictor = gsparc.load(file)
    for _ in range(2):
        predictor.accepts(tx=data.tx[fold.train[:2]] + data.site.origin)
    said = [record.getMessage() for record in caplog.records if "accepts" in record.getMessage()]
    assert len(said) == 1 and "26 %" in said[0] and "10 %" in said[0]
