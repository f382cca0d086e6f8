import numpy as np
import torch
from rooms import nmse, shoebox

from gsparc.methods.method import FitContext
from gsparc.methods.registry import method_class
from gsparc.multipath.complex_gp import ComplexGP


def _dense():
    """Receivers a third of a wavelength apart: close enough to interpolate without sources."""
    return shoebox(260, size=(0.7, 0.6, 0.6), max_order=1)


def test_between_dense_receivers_and_back_from_disk(tmp_path):
    _, data, fold = _dense()
    method = ComplexGP()
    report = method.fit(data, fold, FitContext(tmp_path))
    batch = data.batch(fold.test)
    prediction = method.predict(batch.tx, batch.rx)
    assert nmse(prediction.mean.numpy(), batch.target.numpy()) < 0.3
    error = (prediction.mean - batch.target).abs().square().mean()
    assert 0.2 < prediction.variance.mean() / error < 5
    assert report.notes[0].startswith("complex_gp: envelope")
    torch.save(method.state(), tmp_path / "state.pt")
    again = ComplexGP()
    again.restore(data.site, torch.load(tmp_path / "state.pt", weights_only=True))
    torch.testing.assert_close(again.predict(batch.tx, batch.rx).mean, prediction.mean)


def test_far_from_all_measurements_it_says_nothing(tmp_path):
    _, data, fold = _dense()
    method = ComplexGP()
    method.fit(data, fold, FitContext(tmp_path))
    batch = data.batch(fold.test[:1])
    far = method.predict(batch.tx, type(batch.rx)(batch.rx.position + 1000, batch.rx.rotation))
    assert far.mean.abs().max() < 1e-3
    assert far.confidence.item() < 1e-3


def test_it_has_its_name():
    assert method_class("complex_gp") is ComplexGP
    assert np.isclose(ComplexGP().size(), 0)
