"""Edits of a field whose emissions were solved for: the read-out is solved again, spectra stay."""

import pytest
import torch
from campaigns import brief, compose, spectra
from contexts import loaded, short

from gsparc.callbacks import Densify
from gsparc.field import edit
from gsparc.field.readout import solve_readout
from gsparc.models.registry import build


@pytest.mark.parametrize("more", [(), ("model.attenuation.inverse_distance=true",)])
def test_clones_after_a_closed_form_keep_the_rendered_image(tmp_path, more):
    """Copies with their parents' opacities and emissions changed spectra by .1 and cost 7 dB."""
    file = spectra(tmp_path / "own.npz", rows=60)
    data, fold = loaded(file)
    method = build(compose(*brief(file, "init=images", *more)).model).create_for(data)
    method.fit(data, fold, short(tmp_path, 0))
    model, batch = method.fitted_model(), data.batch(fold.train[:8])
    densify = Densify(grad_threshold=0.5)
    densify.statistics = densify._zero_statistics(model)
    densify.statistics["gradient"][::20], densify.statistics["seen"] = (
        1.0,
        torch.ones(len(model.gaussians)),
    )
    planned = densify.plan(model, torch.Generator().manual_seed(0), in_place=True)
    before = model(batch.tx, batch.rx).mean
    solved = solve_readout(model, planned, batch)
    edit.apply_edit(planned, model, model.gaussians)
    unsolved = (model(batch.tx, batch.rx).mean - before).square().mean().sqrt()
    with torch.no_grad():
        model.emission.weight2.copy_(solved.weight)
        model.emission.bias2.copy_(solved.bias)
    change = float((model(batch.tx, batch.rx).mean - before).square().mean().sqrt())
    assert len(planned.parents) == 4 and len(model.gaussians) == 42
    assert (
        change == pytest.approx(float(solved.change) ** 0.5, rel=1e-3)
        and change < 1e-3 < 3 * unsolved
    )


def test_emissions_of_networks_are_not_solved_again(tmp_path):
    file = spectra(tmp_path / "own.npz", rows=60)
    data, fold = loaded(file)
    method = build(compose(*brief(file, "model.emission.hidden=4")).model).create_for(data)
    method.fit(data, fold, short(tmp_path, 1))
    assert solve_readout(method.fitted_model(), None, data.batch(fold.train[:2])) is None
