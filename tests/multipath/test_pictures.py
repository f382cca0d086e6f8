import numpy as np
from PIL import Image

from gsparc.multipath.pictures import plot_visibility


def test_learned_and_true_visibility_side_by_side(tmp_path):
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(50, 3))
    true = places[:, :1] > [[0.5, 2.0]]  # the second source is never seen
    path = plot_visibility(tmp_path / "deep" / "seen.png", places, true * 0.9, true, ["a wall", "nothing"])
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] > pixels.shape[0] / 2
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50
