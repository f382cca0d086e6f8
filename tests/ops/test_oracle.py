"""Five hundred random and nasty fields against pictures drawn from the definitions alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle import look

from gsparc.ops import Cutoff, Pose, SphereGrid, rasterize
from gsparc.ops.settings import Optics

GRIDS = (
    SphereGrid.hemisphere(9, 24),
    SphereGrid.full_sphere(8, 20),
    SphereGrid(7, 11, -0.3, 2.9, 0.07, 0.09),
    SphereGrid(5, 1, 1.2, 0.0, 0.08, 0.1),
)
FIELDS, TOGETHER = 500, 50


def drawn(number: int):
    """Gaussians with repeated places, needles, faint and opaque ones; and how they are looked at."""
    rng = np.random.default_rng([18, number])
    count = int(rng.integers(0, 12))
    means = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-1, 1.5, (count, 1))
    if count > 3:
        means[1], means[2] = means[0], -means[0]
    scales = np.exp(rng.normal(-1, 1, (count, 3))) * rng.choice([1.0, 1e-2, 1e-3], (count, 3))
    quats = rng.normal(size=(count, 4)) * 10 ** rng.uniform(-5, 5, (count, 1))
    quats[rng.random(count) < 0.1] = 0
    opacities = rng.choice([0.0, 0.002, 0.1, 0.7, 0.99, 1.0], count)
    extinctions = opacities if rng.random() < 0.5 else rng.choice([0.0, 0.3, 1.0], count)
    features = rng.normal(size=(count, 2))
    ids = rng.permutation(count)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    pose = rng.normal(size=3) * 0.2, turn
    optics = Optics(
        projection=str(rng.choice(["tangent", "equirect"])),
        low_pass=float(rng.choice([0.3, 0.05, 1.0])),
        compensate=bool(rng.random() < 0.5),
        near=float(rng.choice([0.01, 0.5])),
        cutoff=Cutoff() if rng.random() < 0.7 else Cutoff(0.01, 1e-4, relative=True),
    )
    grid = GRIDS[int(rng.integers(len(GRIDS)))]
    return (means, quats, scales, opacities, extinctions, features, ids, pose, grid, optics)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("first", range(0, FIELDS, TOGETHER))
def test_pictures_equal_those_of_the_definitions(backend, first):
    certain = pixels = lit = 0
    for number in range(first, first + TOGETHER):
        means, quats, scales, opacities, extinctions, features, ids, pose, grid, optics = drawn(number)
        wanted = look(means, quats, scales, opacities, extinctions, features, ids, pose, grid, optics)
        tensors = [
            torch.from_numpy(np.ascontiguousarray(a)) for a in (means, quats, scales, opacities, features)
        ]
        found = rasterize(
            *tensors, Pose(*(torch.from_numpy(part) for part in pose)), grid,
            projection=optics.projection, low_pass=optics.low_pass, compensate=optics.compensate,
            near=optics.near, cutoff=optics.cutoff, extinctions=torch.from_numpy(extinctions),
            ids=torch.from_numpy(ids), backend=backend,
        )  # fmt: skip
        ok = wanted.certain
        light, image = found.transmittance[0].numpy(), found.image[0].numpy()
        assert np.abs(np.where(ok, light - wanted.transmittance, 0)).max(initial=0) < 1e-9, number
        assert np.abs(np.where(ok, image - wanted.image, 0)).max(initial=0) < 1e-8, number
        certain, pixels, lit = certain + ok.sum(), pixels + ok.size, lit + (wanted.transmittance < 0.99).sum()
    assert certain > 0.99 * pixels and lit > 0.05 * pixels
