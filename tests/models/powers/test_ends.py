"""Powers between ends that both move: what each end's place adds, whatever the other is."""

import numpy as np
import pytest
import torch

from gsparc.data.splits import Fold
from gsparc.models import checkpoint, loading
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.target_rows import power_rows
from gsparc.processes import powers
from gsparc.processes.kernel import EndShadowing, Kernel, Shadowing, WhiteNoise
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

KNOWN = 250


def mesh(gains_db: float, nodes: int = 20, silent_below: float | None = None):
    """Every node heard by every other; gains of sending and of hearing, 1 dB of noise."""
    rng = np.random.default_rng(0)
    place = np.c_[rng.uniform(0, [60, 40], (nodes, 2)), np.full(nodes, 1.5)]
    first, second = np.nonzero(~np.eye(nodes, dtype=bool))
    order = rng.permutation(len(first))
    first, second = first[order], second[order]
    sends, hears = gains_db * rng.normal(size=(2, nodes))
    far = np.linalg.norm(place[first] - place[second], axis=1)
    level = -40 - 25 * np.log10(far) + sends[first] + hears[second] + rng.normal(size=len(far))
    arrays = {"tx_position": place[first], "rx_position": place[second], "rssi_db": level}
    if silent_below is not None:
        level[level < silent_below] = np.nan
        arrays["sensitivity_db"] = np.array(silent_below)
    return from_arrays(arrays)


def fitted(data):
    rows, method = np.arange(len(data)), GaussianProcess()
    method.fit(data, Fold(rows[:KNOWN], rows[:0], rows[KNOWN:]), FitContext())
    return method, data.batch(rows[KNOWN:])


def error_db(method, batch) -> float:
    return float(
        (10 * torch.log10(method.predict(batch).mean / batch.target)).square().mean().sqrt()
    )


def test_gains_of_nodes_were_shadows_of_links(tmp_path):
    """A mesh had 2.9 dB where noise is 1 dB:
    each link was told by links with both ends near alone.
    """
    method, batch = fitted(mesh(3.0))
    kernel = method.powers.kernel
    assert [type(term) for term in kernel.signals] == [Shadowing, EndShadowing, EndShadowing]
    assert [term.other for term in kernel.signals[1:]] == [False, True]
    assert kernel.description.count("of each end") == 2
    assert error_db(method, batch) < 1.4
    checkpoint.save(tmp_path / "m.ckpt", method)
    again, _ = loading.load(tmp_path / "m.ckpt")
    torch.testing.assert_close(again.predict(batch).mean, method.predict(batch).mean)


@pytest.mark.slow
def test_links_without_gains_have_none():
    kernel = fitted(mesh(0.0))[0].powers.kernel
    assert all(term.share < 0.05 for term in kernel.signals if isinstance(term, EndShadowing))


@pytest.mark.slow
def test_silent_links_and_more_than_one_factor_holds(monkeypatch):
    data = mesh(3.0, silent_below=-82.0)
    assert 20 < (data.censored_side(np.arange(len(data))) > 0).sum() < 150
    method, _ = fitted(data)
    assert not method.powers.kernel.is_isotropic
    monkeypatch.setattr(powers, "MOST_ROWS", 200)
    rows = power_rows(mesh(3.0), np.arange(300))
    process, notes = powers.condition_on_powers(rows, method.powers.posterior.prior, 0)
    assert len(process.places) == 200 and "200 of 300 rows, drawn evenly, are learned from" in notes


@pytest.mark.parametrize("other", [False, True])
def test_covariance_is_of_one_end_with_slopes(other):
    term = EndShadowing(2.0, 0.5, other)
    places = torch.tensor(np.random.default_rng(0).normal(size=(4, 6)), requires_grad=True)
    rows = torch.tensor(np.random.default_rng(1).normal(size=(3, 6)))
    assert torch.autograd.gradcheck(lambda at: term.covariance(at, rows), places)
    moved = places.detach().clone()
    moved[:, :3] += 1.0 if other else 0.0
    moved[:, 3:] += 0.0 if other else 1.0
    torch.testing.assert_close(
        term.covariance(moved, moved), term.covariance(places, places).detach()
    )
    kernel = Kernel((Shadowing(1.0, 0.5), term, WhiteNoise(0.1)))
    again = kernel.with_values(kernel.parameters())
    torch.testing.assert_close(again.gram(moved), kernel.gram(moved))
    assert len(kernel.bounds(moved)) == len(kernel.parameters())
