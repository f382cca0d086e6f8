import pytest
import torch

from gsparc.field.gaussians import FieldSettings, create_field

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 2.0, 1.0]])
RECEIVER = torch.tensor([3.0, 0.0, 1.0])
TURN = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # boresight along x


def test_sphere_surrounds_the_receiver_above_its_horizon():
    field = create_field(
        FieldSettings(count=500, placement="sphere", near=1, far=6), BOX, RECEIVER, TURN
    )
    local = (field.means - RECEIVER) @ TURN
    distance = local.norm(dim=1)
    assert distance.min() >= 1 and distance.max() <= 6 and (local[:, 2] > 0).all()
    directions = local / distance[:, None]
    # Even on the hemisphere: the mean direction is (0, 0, 1/2), heights are uniform.
    assert torch.allclose(directions.mean(0), torch.tensor([0.0, 0.0, 0.5]), atol=0.01)


def test_sphere_needs_a_receiver_that_stays():
    with pytest.raises(ValueError, match="use init=uniform"):
        create_field(FieldSettings(placement="sphere"), BOX, None, None)


def test_an_unknown_start_is_refused():
    with pytest.raises(ValueError, match="choose uniform, grid or sphere"):
        create_field(FieldSettings(placement="auto"), BOX, RECEIVER, TURN)


@pytest.mark.parametrize("init", ["uniform", "sphere"])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_opacity_scale_and_ids_are_as_asked(init, count):
    settings = FieldSettings(count=count, placement=init, opacity=0.2, scale=0.4)
    field = create_field(settings, BOX, RECEIVER, TURN)
    assert (
        len(field) == count
        and field.ids.tolist() == list(range(count))
        and int(field.next_id) == count
    )
    assert torch.allclose(field.opacities, torch.full((count,), 0.2))
    assert torch.allclose(field.scales, torch.full((count, 3), 0.4))
    assert (
        create_field(FieldSettings(count=count, placement=init), BOX, RECEIVER, TURN)
        .scales.isfinite()
        .all()
    )


def test_a_flat_box_still_gives_positive_scales():
    """Positions in one plane without a margin: a volume of 0."""
    flat = torch.tensor([[0.0, 0, 0], [4, 4, 0]])
    field = create_field(FieldSettings(count=10, placement="uniform", margin=0.0), flat, None, None)
    assert (field.scales > 0).all() and field.log_scales.isfinite().all()


def test_a_grid_fills_the_box_and_says_where_it_is_too_fine():
    box = torch.tensor([[-7.0, -4.0, 0.0], [7.0, 6.0, 4.0]])
    field = create_field(FieldSettings(placement="grid", margin=0, spacing=0.3), box, None, None)
    assert len(field) == 46 * 33 * 13 and float(field.scales.max()) == pytest.approx(0.3)
    assert torch.equal(field.means.amin(0), box[0]) and torch.equal(field.means.amax(0), box[1])
    with pytest.raises(
        ValueError, match=r"spacing=0.01 m makes 560,000,000 Gaussians .* raise model.field"
    ):
        create_field(FieldSettings(placement="grid", margin=0, spacing=0.01), box, None, None)
