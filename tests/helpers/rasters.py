"""Random fields of Gaussians, and everything a rasterizer makes of them: outputs and gradients."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, replace

import pytest
import torch
from ledger import LEDGER
from torch import Tensor

from gsparc.ops import Pose, SphereGrid, composite, make_plan

GRIDS = {
    "hemisphere": SphereGrid.hemisphere(30, 120),
    "sphere": SphereGrid.full_sphere(24, 48),
    "patch": SphereGrid(20, 37, -0.3, 2.5, 0.04, 0.05),
}


@dataclass(frozen=True)
class Scene:
    """N Gaussians and the features of B samples."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    ids: Tensor | None = None

    @property
    def model(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What planning takes."""
        return self.means, self.quats, self.scales, self.opacities

    def to(self, dtype: torch.dtype) -> Scene:
        return replace(
            self,
            **{
                k: v.to(dtype)
                for k, v in vars(self).items()
                if v is not None and v.is_floating_point()
            },
        )

    def on(self, device: str) -> Scene:
        return replace(self, **{k: v.to(device) for k, v in vars(self).items() if v is not None})

    def permuted(self, order: Tensor) -> Scene:
        parts = {k: v[order] for k, v in vars(self).items() if v is not None and k != "features"}
        return replace(self, **parts, features=self.features[:, order])


def random_scene(
    n: int = 60, channels: int = 2, samples: int = 3, *, seed: int = 0, size: float = 0.4
) -> Scene:
    """Gaussians all around the origin, a few metres away,
    float64 values that float32 holds exactly.
    """
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw).double()

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=draw).double()

    return (
        Scene(
            means=2 * normal(n, 3),
            quats=normal(n, 4),
            scales=uniform(n, 3) * size + 0.02,
            opacities=uniform(n) * 0.95 + 0.02,
            features=normal(samples, n, channels),
        )
        .to(torch.float32)
        .to(torch.float64)
    )


def one(direction, *, distance: float = 4.0, sigma: float = 0.2, opacity: float = 0.8) -> Scene:
    """One round Gaussian with feature 1, in float64."""
    d = torch.tensor([direction], dtype=torch.float64)
    return Scene(
        means=distance * d / d.norm(),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        scales=torch.full((1, 3), sigma, dtype=torch.float64),
        opacities=torch.tensor([opacity], dtype=torch.float64),
        features=torch.ones(1, 1, 1, dtype=torch.float64),
    )


def poses(count: int, seed: int = 1) -> Pose:
    """`count` random poses near the origin; 0 stands for one shared pose.
    Rotations are exact in float64.
    """
    draw = torch.Generator().manual_seed(seed)
    size = max(count, 1)
    turn = torch.linalg.qr(torch.randn(size, 3, 3, generator=draw, dtype=torch.float64))[0]
    place = 0.3 * torch.randn(size, 3, generator=draw).double()
    return Pose(place, turn) if count else Pose(place[0], turn[0])


def origin() -> Pose:
    return Pose.identity(torch.zeros(3, dtype=torch.float64))


class Outcome(dict[str, Tensor]):
    """Outputs and gradients by name, and who made them in which precision."""

    def __init__(self, found: dict[str, Tensor], engine: str, precision: str) -> None:
        super().__init__(found)
        self.engine, self.precision = engine, precision


def render(
    scene: Scene,
    pose: Pose,
    grid: SphereGrid,
    backend: str = "cpu",
    *,
    upstream: Tensor | None = None,
    behind: bool = True,
    pixels: Tensor | None = None,
    **optics,
) -> Outcome:
    """Image, transmittance, and the gradients of a fixed random linear function
    of both over `pixels`.
    """
    started = time.perf_counter()
    names = ["means", "quats", "scales", "opacities", "features"]
    leaves = {name: getattr(scene, name).clone().requires_grad_() for name in names}
    model = [leaves[name] for name in names[:4]]
    plan = make_plan(*model, pose, grid, ids=scene.ids, backend=backend, **optics)
    raster = composite(plan, *model, leaves["features"])
    draw = torch.Generator().manual_seed(5)
    if upstream is None:
        upstream = torch.randn(raster.image.shape, generator=draw, dtype=torch.float64)
    upstream = upstream if pixels is None else upstream * pixels
    loss = (raster.image * upstream.to(raster.image)).sum()
    if behind:
        weight = torch.randn(raster.transmittance.shape, generator=draw, dtype=torch.float64)
        weight = weight if pixels is None else weight * pixels
        loss = loss + (raster.transmittance * weight.to(raster.image)).sum()
    loss.backward()
    out = {f"d_{name}": leaf.grad for name, leaf in leaves.items()}
    out |= {"image": raster.image.detach(), "transmittance": raster.transmittance.detach()}
    out |= {"radii": raster.radii, "visible": raster.visible, "d_means2d": raster.means2d.grad}
    engine = backend if backend == "reference" else LEDGER.engine or backend
    precision = str(scene.means.dtype).removeprefix("torch.")
    LEDGER.rendered(engine, precision, time.perf_counter() - started)
    return Outcome(out, engine, precision)


def worst(got: dict[str, Tensor], want: dict[str, Tensor]) -> dict[str, float]:
    """Largest difference of each output, relative to one plus the largest value wanted."""
    differences = {}
    for name, value in want.items():
        if name in ("radii", "visible"):
            continue
        gap = (got[name].double() - value.double()).abs()
        differences[name] = float((gap / (1 + value.abs().max())).max()) if gap.numel() else 0.0
    return differences


def assert_close(got: dict[str, Tensor], want: dict[str, Tensor], tolerance: float) -> None:
    gaps = worst(got, want)
    if isinstance(got, Outcome):
        for name, gap in gaps.items():
            part = "backward" if name.startswith("d_") else "forward"
            LEDGER.compared(got.engine, got.precision, part, gap, tolerance)
    bad = {name: gap for name, gap in gaps.items() if not gap < tolerance}
    assert not bad, f"beyond {tolerance}: {bad}"


_truths: dict[bytes, Outcome] = {}


def truth(scene: Scene, pose: Pose, grid: SphereGrid, **optics) -> Outcome:
    """The reference in float64, computed once for all backends and precisions."""
    tensors = [
        part for part in (*vars(scene).values(), pose.position, pose.rotation) if part is not None
    ]
    parts = [repr((grid, sorted(optics.items()), [t.shape for t in tensors])).encode()]
    key = hashlib.sha256(b"".join([*parts, *(t.numpy().tobytes() for t in tensors)])).digest()
    if key not in _truths:
        _truths[key] = render(scene, pose, grid, "reference", **optics)
    return _truths[key]


TOLERANCES = {torch.float64: 1e-9, torch.float32: 1e-4}
PROJECTED = ("tangent", "equirect")
PROJECTIONS = pytest.mark.parametrize("projection", PROJECTED)


def assert_equals_reference(
    scene: Scene, pose: Pose, grid: SphereGrid, dtype: torch.dtype = torch.float64, **optics
) -> tuple[Outcome, Outcome]:
    """The kernels in `dtype` against the reference in float64; both are returned."""
    want = truth(scene, pose, grid, **optics)
    got = render(scene.to(dtype), pose, grid, **optics)
    assert_close(got, want, TOLERANCES[dtype])
    return got, want


def assert_equals_float64(
    scene: Scene,
    pose: Pose,
    grid: SphereGrid,
    backend: str,
    tolerances: dict[torch.dtype, float] = TOLERANCES,
    **optics,
) -> Outcome:
    """The backend in both precisions against the reference in float64, which is returned;
    all finite.
    """
    scene = scene.to(torch.float32).to(torch.float64)
    want = truth(scene, pose, grid, **optics)
    for dtype, tolerance in tolerances.items():
        if backend == "reference" and dtype == torch.float64:
            continue
        got = render(scene.to(dtype), pose, grid, backend, **optics)
        assert all(torch.isfinite(value).all() for value in got.values())
        assert_close(got, want, tolerance)
    return want
