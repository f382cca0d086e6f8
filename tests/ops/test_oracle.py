"""Five hundred random and nasty fields against pictures drawn from the definitions alone.

That gradients are the slopes of these pictures: test_kernels.py::test_gradcheck.
"""

import math

import numpy as np
import pytest
import torch
from fields import GRIDS, Drawn, fields
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracle import look

from gsparc.ops import Pose, SphereGrid, rasterize
from gsparc.ops.settings import Optics

# Both of them
POLES = SphereGrid(9, 16, -math.pi / 2, -7.5, math.pi / 8, 2 * math.pi / 16 * (1 - 1e-7))
TURN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)


def worst(found: torch.Tensor, want: np.ndarray, certain: np.ndarray) -> float:
    """The largest difference where it is certain."""
    return float(np.abs(np.where(certain, found.numpy() - want, 0)).max(initial=0))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_pictures_equal_those_of_the_definitions(backend):
    counts = np.zeros(3)  # pixels that are certain, all, and those with a layer

    @settings(
        max_examples=500,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn=fields(st.one_of(GRIDS, st.just(POLES))), apart=st.booleans())
    def check(drawn: Drawn, apart: bool) -> None:
        """Both samples from one pose, or the second from another one."""
        scene, (left, _, right) = drawn.scene, torch.linalg.svd(drawn.pose.rotation)
        first = Pose(drawn.pose.position, left @ right)  # it was rounded to float32
        both = Pose(
            torch.stack([first.position, first.position + 0.1]),
            torch.stack([first.rotation, TURN @ first.rotation]),
        )
        raster = rasterize(
            *scene.model,
            scene.features,
            both if apart else first,
            drawn.grid,
            ids=scene.ids,
            backend=backend,
            **drawn.optics,
        )
        model = [part.numpy() for part in scene.model]
        for index in range(1 + apart):
            samples = slice(index, index + 1) if apart else slice(2)
            pose = both.position[index].numpy(), both.rotation[index].numpy()
            given = scene.features[samples].numpy(), scene.ids.numpy(), pose
            want = look(*model, *given, drawn.grid, Optics(**drawn.optics))
            assert worst(raster.transmittance[index], want.transmittance, want.certain) < 1e-9
            assert worst(raster.image[samples], want.image, want.certain) < 1e-8
            visible = raster.visible[index].numpy()
            assert not (want.reached & ~visible).any()
            assert np.allclose(
                raster.radii[index], np.where(visible, want.radii, 0), rtol=1e-7, atol=1e-9
            )
            counts[:] += want.certain.sum(), want.certain.size, (want.transmittance < 0.99).sum()

    check()
    assert counts[0] > 0.95 * counts[1] and counts[2] > 0.05 * counts[1], counts
