"""Everything at once: fields, poses, grids and precisions that nobody thought of, drawn by tests/fields.py.

Remedy: all of them together. Bound of every comparison: FACTOR rounding errors of the input, carried to the
output as the float64 reference carries them: `fields.condition` measures how far, by nudging every number of
the input by one unit of float32's rounding. Thousands of examples stayed below 9 such errors. Pixels so near
a threshold that one such unit crosses it are left out of the comparison and of the gradients; all are finite.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from fields import CIRCLES, Drawn, assert_within, condition, fields, layers, show
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from ledger import LEDGER
from rasters import one, origin, render

from gsparc.ops import Cutoff, Pose, SphereGrid, freeze, make_plan, mean_weights

FACTOR = 16


def effort(fast: int, many: int):
    """`fast` examples in `make test`, a third of `many` in `make test-slow`, all in `make rare`."""
    some = pytest.param(many // 3, marks=pytest.mark.slow, id="some")
    thorough = pytest.param(many, marks=(pytest.mark.slow, pytest.mark.rare), id="many")
    return pytest.mark.parametrize("examples", [pytest.param(fast, id="few"), some, thorough])


def holds(examples: int, *, property, **drawn) -> None:
    """`property` of that many drawn examples."""

    def counted(**values):
        LEDGER.count("examples of properties")
        property(**values)

    quiet = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]
    setting = settings(
        max_examples=examples, deadline=None, database=None, derandomize=True, suppress_health_check=quiet
    )
    setting(given(**drawn)(counted))()


@effort(25, 400)
def test_finite(backend, examples):
    def finite(drawn: Drawn):
        got = show(drawn, backend)
        assert all(value.isfinite().all() for value in got.values())

    holds(examples, property=finite, drawn=fields())


@effort(10, 300)
def test_equals_float64_within_the_condition_of_the_input(backend, examples):
    def equal(drawn: Drawn):
        known = condition(drawn)
        if (backend, drawn.dtype) != ("reference", torch.float64):
            assert_within(show(drawn, backend, pixels=known.steady), known, FACTOR)

    holds(examples, property=equal, drawn=fields())


@effort(6, 150)
def test_turning_about_the_boresight_rolls_the_image(backend, examples):
    def rolls(drawn: Drawn, columns: int):
        local = drawn.pose.local(drawn.scene.means)
        # On the axis itself east and north, and with them columns and screen gradients, have no direction.
        assume((local[:, :2].norm(dim=1) > 1e-6 * local.norm(dim=1)).all())
        columns = columns % drawn.grid.width
        draw = torch.Generator().manual_seed(1)
        noise = torch.randn(2, 1, drawn.grid.height, drawn.grid.width, generator=draw, dtype=torch.float64)
        known = condition(drawn, upstream=noise, behind=False)
        c, s = (f(columns * drawn.grid.azimuth_step) for f in (math.cos, math.sin))
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        turned = replace(drawn, pose=Pose(drawn.pose.position, drawn.pose.rotation @ turn.mT))
        rolled = {"upstream": noise.roll(columns, -1), "pixels": known.steady.roll(columns, -1)}
        got = show(turned, backend, behind=False, **rolled)
        for name in ("image", "transmittance"):
            got[name] = got[name].roll(-columns, -1)
        assert_within(got, known, FACTOR)

    holds(examples, property=rolls, drawn=fields(grids=CIRCLES), columns=st.integers(1, 40))


@effort(15, 300)
def test_permuting_rows_with_their_ids_changes_nothing(backend, examples):
    if backend == "reference":
        pytest.skip("the reference adds in the order of the rows: equal within rounding only (test_ties.py)")

    def unchanged(drawn: Drawn, seed: int):
        order = torch.randperm(len(drawn.scene.ids), generator=torch.Generator().manual_seed(seed))
        straight = show(drawn, backend)
        mixed = show(replace(drawn, scene=drawn.scene.permuted(order)), backend)
        for name in ("image", "transmittance"):
            assert torch.equal(straight[name], mixed[name]), name
        for name in ("d_means", "d_quats", "d_scales", "d_opacities"):
            assert torch.equal(straight[name][order], mixed[name]), name

    holds(examples, property=unchanged, drawn=fields(), seed=st.integers(0, 99))


@effort(15, 300)
def test_no_more_energy_comes_than_was_there(backend, examples):
    """With features of 1, what is seen and what is left behind add up to 1."""

    def conserved(drawn: Drawn):
        scene = drawn.scene
        bright = replace(drawn, scene=replace(scene, features=torch.ones_like(scene.features)))
        got = show(bright, backend)
        image, behind = got["image"][:, 0], got["transmittance"]
        slack = 4 * torch.finfo(drawn.dtype).eps * (1 + len(scene.means))
        assert (image >= 0).all() and (image <= 1 + slack).all() and (behind >= 0).all()
        assert ((image + behind - 1).abs() <= slack).all()

    holds(examples, property=conserved, drawn=fields(hides=False))


@effort(8, 200)
def test_gradient_is_exactly_zero_where_nothing_is_seen(backend, examples):
    """Behind the stopping rule, below the cut-off, inside the near cut, off the grid: 0, nothing small."""

    def zero(drawn: Drawn):
        steady = condition(drawn, nudges=2).steady
        seen = layers(drawn)
        counts = (seen.strength >= drawn.cutoff.alpha) & (seen.light > 0) & steady.flatten()
        unseen = torch.ones(len(seen.order), dtype=torch.bool)
        unseen[seen.order[counts.any(1)]] = False
        got = show(drawn, backend, pixels=steady)
        for name in ("d_means", "d_quats", "d_scales", "d_opacities"):
            assert (got[name][unseen] == 0).all(), name
        assert (got["d_features"][:, unseen] == 0).all()

    holds(examples, property=zero, drawn=fields())


@effort(10, 200)
def test_weights_and_frozen_views_say_the_same(backend, examples):
    def same(drawn: Drawn):
        scene, optics = drawn.scene.to(drawn.dtype), drawn.optics
        model = scene.model
        hidden = {"extinctions": scene.extinctions}
        plan = make_plan(*model, drawn.pose, drawn.grid, ids=scene.ids, backend=backend, **hidden, **optics)
        seen, view = mean_weights(plan, *model, **hidden), freeze(plan, *model, version=0, **hidden)
        slack = 1 + 64 * torch.finfo(drawn.dtype).eps
        assert ((seen.share >= 0) & (seen.share <= slack)).all()
        assert ((seen.mean >= 0) & (seen.mean <= slack)).all()
        image = show(drawn, backend)["image"]
        largest = float(scene.features.abs().max()) if len(scene.means) else 0.0
        room = 64 * torch.finfo(drawn.dtype).eps * (1 + len(scene.means) * largest)
        assert ((view.render(scene.features, version=0) - image).abs() <= room).all()

    holds(examples, property=same, drawn=fields())


@effort(25, 500)
def test_any_number_is_refused_by_name_or_harmless(backend, examples):
    """NaN, infinities, denormals, 1e38 in one place of one Gaussian."""

    def sound(drawn: Drawn, name: str, row: int, value: float):
        assume(len(drawn.scene.means) > 0)
        row = row % len(drawn.scene.means)
        values = getattr(drawn.scene, name).clone()
        values[row].view(-1)[0] = value
        spoilt = replace(drawn, scene=replace(drawn.scene, **{name: values}))
        try:
            got = show(spoilt, backend)
        except ValueError as refused:
            assert f"Gaussian {row} has {name}" in str(refused) and "\n" not in str(refused)
            return
        assert math.isfinite(value) and all(found.isfinite().all() for found in got.values())

    anything = st.one_of(
        st.floats(width=32, allow_nan=True, allow_infinity=True, allow_subnormal=True),
        st.sampled_from([math.nan, math.inf, -math.inf, 1e38, -1e38, 1e-45, 1e-38, 1e19, 1e6, 1e5, -0.0]),
    )
    names = st.sampled_from(["means", "quats", "scales", "opacities"])
    holds(
        examples,
        property=sound,
        drawn=fields(hides=False),
        name=names,
        row=st.integers(0, 9),
        value=anything,
    )


def test_the_bound_sees_three_lost_digits():
    """Able to fail: means that are wrong by a thousand roundings give a result far beyond the bound."""
    drawn = Drawn(
        one([0.4, 0.3, 0.6]), origin(), SphereGrid.hemisphere(8, 32), "tangent", 0.3, True, Cutoff()
    )
    known = condition(drawn)
    rough = replace(drawn.scene, means=drawn.scene.means * (1 + 1000 * 2.0**-23))
    got = render(rough, drawn.pose, drawn.grid, "cpu", pixels=known.steady, **drawn.optics)
    got.engine, got.precision = "spoilt on purpose", "float32"
    with pytest.raises(AssertionError, match="beyond"):
        assert_within(got, known, FACTOR)
