import pytest
import torch
from skimage.metrics import structural_similarity

from gsparc.field.losses import channel_loss, spectrum_loss, ssim


def images(batch: int = 3, height: int = 20, width: int = 31, seed: int = 0) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    return torch.rand(batch, height, width, generator=draw, dtype=torch.float64)


def test_ssim_is_scikit_images():
    a, b = images(seed=0), images(seed=1)
    want = [
        structural_similarity(
            x.numpy(),
            y.numpy(),
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1,
        )
        for x, y in zip(a, b, strict=True)
    ]
    assert torch.allclose(ssim(a, b), torch.tensor(want, dtype=torch.float64), atol=1e-12)


def test_the_written_backward_is_the_derivative():
    a, b = images(2, 13, 15).requires_grad_(), images(2, 13, 15, seed=1)
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), (a,))


def test_second_derivatives_are_right_or_refused():
    """In float32 they were 0, or wrong by half, without a word."""
    a, b = images(1, 11, 12).requires_grad_(), images(1, 11, 12, seed=1)

    def total(x):
        return ssim(x, b.to(x.dtype)).sum()

    exact = torch.autograd.functional.hessian(total, a)
    assert exact.abs().max() > 0.01
    assert torch.allclose(torch.func.hessian(total)(a.detach().float()).double(), exact, atol=1e-4)
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.functional.hessian(total, a.detach().float())


def test_too_small_an_image_is_refused():
    with pytest.raises(ValueError, match="at least 11 x 11"):
        ssim(images(1, 10, 30), images(1, 10, 30))


def test_spectrum_loss_mixes_l1_and_ssim_of_images_that_hold_its_window():
    """The default loss refused a user's own 10 x 40 spectra, and named no way out."""
    for size, weight, mixed in (((20, 31), 0.2, 0.2), ((20, 31), 0.0, 0.0), ((10, 40), 0.2, 0.0)):
        a, b = images(2, *size), images(2, *size, seed=1)
        want = (1 - mixed) * (a - b).abs().mean((1, 2)) + (mixed * (1 - ssim(a, b)) if mixed else 0)
        assert torch.allclose(spectrum_loss(a, b, weight), want)


def test_channel_loss_is_the_mean_squared_error():
    for shape, dtype in (((4, 2, 3), torch.complex64), ((4, 1), torch.float32)):
        h, g = torch.randn(shape, dtype=dtype), torch.randn(shape, dtype=dtype)
        assert torch.allclose(channel_loss(h, g), (h - g).abs().square().flatten(1).mean(1))


def test_antennas_that_are_not_modelled_are_refused():
    """A file of several antennas without their positions was once fitted by one,
    broadcast to all.
    """
    with pytest.raises(ValueError, match=r"\(4, 1, 3\) channels predicted, \(4, 2, 3\) measured"):
        channel_loss(torch.zeros(4, 1, 3), torch.zeros(4, 2, 3))


def test_channel_loss_counts_what_was_measured():
    h, g = torch.randn(2, 2, 3, dtype=torch.complex64), torch.zeros(2, 2, 3, dtype=torch.complex64)
    mask = torch.tensor([[[True, False, False], [True, False, False]], [[False] * 3, [False] * 3]])
    got = channel_loss(h, g, mask)
    assert torch.allclose(got[0], (h[0, :, 0].abs() ** 2).mean()) and got[1] == 0


@pytest.mark.parametrize("snapshot", ["phase", "phase_timing"])
def test_a_snapshots_own_phase_and_delay_do_not_count(snapshot):
    torch.manual_seed(0)
    h = torch.randn(3, 2, 12, dtype=torch.complex64)
    phase = torch.tensor([0.3, -2.0, 3.0])[:, None, None]
    delay = torch.tensor([0.0, 2.0, -3.0])[:, None, None] / 12 * (snapshot == "phase_timing")
    turned = h * torch.exp(1j * (phase - 2 * torch.pi * delay * torch.arange(12)))
    assert channel_loss(h, turned, snapshot=snapshot).max() < 1e-4
    assert channel_loss(h, turned).min() > 0.01
    assert channel_loss(h, 2 * turned, snapshot=snapshot).min() > 0.5  # amplitude does
    mask = torch.ones(3, 2, 12, dtype=torch.bool)
    mask[..., 9:] = False
    spoiled = torch.where(mask, turned, 50 * turned)
    assert channel_loss(h, spoiled, mask, snapshot).max() < 1e-4


@pytest.mark.parametrize("snapshot", ["phase", "phase_timing"])
def test_slopes_of_the_blind_losses(snapshot):
    torch.manual_seed(1)
    target = torch.randn(2, 2, 5, dtype=torch.complex128)
    parts = torch.randn(2, 2, 5, 2, dtype=torch.float64, requires_grad=True)

    def loss(values):
        return channel_loss(torch.view_as_complex(values), target, snapshot=snapshot)

    # The delay is held on its comb: its best value moves the loss in second order only.
    assert torch.autograd.gradcheck(loss, [parts])


@pytest.mark.parametrize("snapshot", ["none", "phase", "phase_timing"])
@pytest.mark.parametrize("masked", [False, True])
def test_channel_losses_stay_on_the_device_of_the_channels(snapshot, masked):
    """Offsets of timing took their tones from the CPU;
    `meta` mixes with those as little as a GPU does.
    """
    channels = torch.empty(3, 2, 5, dtype=torch.complex64, device="meta")
    mask = torch.empty(3, 2, 5, dtype=torch.bool, device="meta") if masked else None
    assert channel_loss(channels, channels, mask, snapshot).device.type == "meta"
