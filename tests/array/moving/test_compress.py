import numpy as np

from gsparc.array.moving.compress import components
from gsparc.methods.gp import principal_components


def smooth_images(count=30, seed=0):
    """Images of a few wide spots, as an array sees them."""
    rng = np.random.default_rng(seed)
    row, column = np.arange(24)[:, None] / 24, np.arange(48)[None] / 48
    spots = [np.exp(-((row - a) ** 2 + (column - b) ** 2) / 0.02) for a, b in rng.uniform(size=(6, 2))]
    return (
        (rng.uniform(size=(count, 6)) @ np.array(spots).reshape(6, -1))
        .reshape(count, 24, 48)
        .astype(np.float32)
    )


def test_thinned_inner_products_give_the_same_subspace():
    images = smooth_images()
    ours, exact = components(images, 6), principal_components(images, "spectrum", 6)
    np.testing.assert_allclose(ours.axes @ ours.axes.T, np.eye(6), atol=1e-5)
    again, wanted = (c.scores @ c.axes + c.mean for c in (ours, exact))
    np.testing.assert_allclose(again, images.reshape(30, -1), atol=1e-3)
    np.testing.assert_allclose(again, wanted, atol=1e-3)
    assert ours.lost < 1e-6


def test_what_is_left_out_is_counted():
    images = smooth_images()
    few = components(images, 2)
    again = few.scores @ few.axes + few.mean
    np.testing.assert_allclose(few.lost, np.mean((images.reshape(30, -1) - again) ** 2), rtol=1e-3)


def test_one_image_has_a_mean_and_nothing_else():
    one = components(smooth_images(1), 5)
    assert one.axes.shape[0] == 1 and abs(one.scores).max() < 1e-4
