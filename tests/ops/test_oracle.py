"""Five hundred random and nasty fields against pictures drawn from the definitions alone.

That gradients are the slopes of these pictures: test_kernels.py::test_gradcheck.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from oracle import Seen, look

from gsparc.ops import Cutoff, Pose, SphereGrid, rasterize
from gsparc.ops.results import Raster
from gsparc.ops.settings import Optics

GRIDS = (
    SphereGrid.hemisphere(9, 24),
    SphereGrid.full_sphere(8, 20),
    SphereGrid.full_sphere(17, 40),
    SphereGrid(7, 11, -0.3, 2.9, 0.07, 0.09),
    SphereGrid(5, 1, 1.2, 0.0, 0.08, 0.1),
    SphereGrid(9, 16, -math.pi / 2, -7.5, math.pi / 8, 2 * math.pi / 16 * (1 - 1e-7)),  # both poles
)
FIELDS, TOGETHER = 500, 50
BACKENDS = pytest.mark.parametrize("backend", ["reference", "cpu"])
FIRST = pytest.mark.parametrize("first", range(0, FIELDS, TOGETHER))


@dataclass(frozen=True)
class Field:
    """N Gaussians and features (B, N, C), seen from P poses, in NumPy."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    features: np.ndarray
    ids: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    grid: SphereGrid
    optics: Optics

    def seen(self, unsure: float) -> list[Seen]:
        """By each pose: all samples by a single one, else each its own."""
        parts = [self.features] if len(self.positions) == 1 else self.features[:, None]
        model = (self.means, self.quats, self.scales, self.opacities)
        poses = zip(self.positions, self.rotations, strict=True)
        return [
            look(*model, part, self.ids, pose, self.grid, self.optics, unsure)
            for part, pose in zip(parts, poses, strict=True)
        ]

    def rendered(self, backend: str, dtype: torch.dtype = torch.float64) -> Raster:
        """By a backend."""
        parts = (self.means, self.quats, self.scales, self.opacities, self.features)
        given = (torch.from_numpy(np.ascontiguousarray(part)).to(dtype) for part in parts)
        *model, features = given
        optics = {name: getattr(self.optics, name) for name in self.optics.__dataclass_fields__}
        pose = Pose(torch.from_numpy(self.positions), torch.from_numpy(self.rotations))
        return rasterize(
            *model, features, pose, self.grid, **optics,
            ids=torch.from_numpy(self.ids), backend=backend,
        )  # fmt: skip


@cache
def drawn(number: int) -> Field:
    """Gaussians with repeated places, needles, faint and opaque ones; and how they are looked at.

    Some stand on the axis or by it, some are far wider than the sphere, some are specks at pixel centres.
    """
    rng = np.random.default_rng([18, number])
    kind = str(rng.choice(["any", "axis", "wide", "speck"], p=[0.55, 0.15, 0.15, 0.15]))
    grid = GRIDS[int(rng.integers(len(GRIDS)))]
    count = int(rng.integers(0, 12)) if rng.random() < 0.8 else 40
    poses = int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1])) if kind == "any" else 1
    samples = int(rng.choice([1, 2])) if poses == 1 else poses
    means = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-1, 1.5, (count, 1))
    if count > 3:
        means[1], means[2] = means[0], -means[0]
    scales = np.exp(rng.normal(-1, 1, (count, 3))) * rng.choice([1.0, 1e-2, 1e-3], (count, 3))
    quats = rng.normal(size=(count, 4)) * 10 ** rng.uniform(-12, 12, (count, 1))
    quats[rng.random(count) < 0.1] = 0
    turn = np.linalg.qr(rng.normal(size=(poses, 3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    place = rng.normal(size=(poses, 3)) * 0.2
    if kind in ("axis", "speck"):
        turn, place = np.eye(3)[None], np.zeros((1, 3))
    if kind == "axis":
        means[:, :2] *= rng.choice([0.0, 1e-12, 1e-6, 1e-3, 0.1], (count, 1))
    if kind == "wide":
        scales *= 10 ** rng.uniform(1, 3, (count, 1))
    if kind == "speck":
        pixels = rng.integers(grid.height * grid.width, size=count)
        aimed = grid.directions().numpy().reshape(-1, 3)[pixels]
        far = np.linalg.norm(means, axis=1, keepdims=True)
        means, scales = aimed * far, far * 10 ** rng.uniform(-6, -4, (count, 3))
    opacities = rng.choice([0.0, 0.002, 0.1, 0.7, 0.99, 1.0], count)
    optics = Optics(
        projection=str(rng.choice(["tangent", "equirect"])),
        low_pass=float(rng.choice([0.3, 0.05, 1.0, 0.0])) if kind != "speck" else 0.0,
        compensate=bool(rng.random() < 0.5),
        near=float(rng.choice([0.01, 0.5])),
        cutoff=Cutoff(
            float(rng.choice([1 / 255, 0.01, 0.2, 1e-6])),
            float(rng.choice([0.0, 1e-4, 0.01, 0.3, 0.8])),
            relative=bool(rng.random() < 0.3),
        ),
    )
    return Field(
        *(means, quats, scales, opacities),
        features=rng.normal(size=(samples, count, int(rng.integers(1, 6)))), ids=rng.permutation(count),
        positions=place, rotations=turn, grid=grid, optics=optics,
    )  # fmt: skip


@cache
def wanted(number: int, unsure: float = 1e-9) -> list[Seen]:
    return drawn(number).seen(unsure)


def worst(found: torch.Tensor, want: np.ndarray, certain: np.ndarray) -> float:
    """The largest difference where it is certain."""
    return float(np.abs(np.where(certain, found.double().numpy() - want, 0)).max(initial=0))


@BACKENDS
@FIRST
def test_pictures_equal_those_of_the_definitions(backend, first):
    certain = pixels = lit = 0
    for number in range(first, first + TOGETHER):
        raster = drawn(number).rendered(backend)
        for index, want in enumerate(wanted(number)):
            image = raster.image if len(wanted(number)) == 1 else raster.image[index : index + 1]
            assert worst(raster.transmittance[index], want.transmittance, want.certain) < 1e-9, number
            assert worst(image, want.image, want.certain) < 1e-8, number
            visible, radii = raster.visible[index].numpy(), raster.radii[index].numpy()
            assert not (want.reached & ~visible).any(), number
            assert np.allclose(radii, np.where(visible, want.radii, 0), rtol=1e-7, atol=1e-9), number
            certain, pixels = certain + want.certain.sum(), pixels + want.certain.size
            lit += (want.transmittance < 0.99).sum()
    assert certain > 0.95 * pixels and lit > 0.05 * pixels
