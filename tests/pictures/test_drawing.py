"""Methods are told apart in every figure, with any colour vision."""

from collections import Counter

import numpy as np
import pytest
from campaigns import compose
from skimage.color import deltaE_ciede2000, rgb2lab

from gsparc.pictures.drawing import PALETTE, style_of

# Linear RGB as seen without cones for red,
# green or blue (Machado, Oliveira and Fernandes 2009, severity 1).
VISION = {
    "all cones": np.eye(3),
    "no red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
    "no blue": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.3039],
    ],
}


@pytest.mark.parametrize("vision", VISION)
def test_brown_beside_vermillion_without_cones_for_red(vision):
    """The brown of the distance law was the vermillion of gsparc
    for protanopes (difference 2.5).
    """
    colours = [*PALETTE, "#6E6E6E"]
    rgb = np.array([[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(VISION[vision]).T, 0, 1)
    lab = rgb2lab(
        np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)[None]
    )[0]
    apart = deltaE_ciede2000(lab[:, None], lab[None])
    assert apart[~np.eye(len(lab), dtype=bool)].min() > 10


def test_four_methods_of_a_comparison_shared_one_colour():
    methods = compose(config="compare").methods
    for kind in ("spectrum", "csi", "rssi"):
        names = [name for name, one in methods.items() if kind in one.get("kinds", [kind])]
        looks = {name: style_of(name) for name in names}
        assert len(set(looks.values())) == len(names), kind
        plain = [one for name, one in looks.items() if not name.endswith("_together")]
        assert max(Counter((one.colour, one.second) for one in plain).values()) == 1, kind
