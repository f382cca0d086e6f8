"""Fields, poses and grids of every hard kind at once, and how ill-conditioned they are.

A field is drawn Gaussian by Gaussian from named kinds,
so that a failure shrinks to the kinds that matter.
"""

import hashlib
import math
from dataclasses import dataclass, replace

import torch
from hypothesis import strategies as st
from ledger import LEDGER
from rasters import Outcome, Scene, render
from torch import Tensor

from gsparc.ops import Cutoff, Pose, SphereGrid, reference
from gsparc.ops.projection import HORIZON_COSINE
from gsparc.ops.settings import ALPHA_MAX, SHORTEST_QUATERNION, Optics

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}

GRIDS = st.sampled_from(
    [
        SphereGrid.hemisphere(8, 32),
        SphereGrid.full_sphere(9, 24),
        SphereGrid.hemisphere(1, 16),
        SphereGrid(7, 11, -0.3, 2.9, 0.07, 0.09),  # across the seam
        SphereGrid(5, 1, 1.2, 0.0, 0.08, 0.1),  # one column, up to the pole
        SphereGrid(3, 67, -0.05, -3.1, 0.05, 0.093),  # nearly the whole circle
    ]
)
DIRECTIONS = {
    "anywhere": None,
    "seam": (-1.0, 1e-7, 0.3),
    "zenith": (0.0, 0.0, 1.0),
    "near zenith": (1e-6, -1e-6, 1.0),
    "nadir": (0.0, 0.0, -1.0),
    "horizon": (0.6, 0.8, 0.0),
    "below": (0.5, -0.5, -0.4),
}
QUATERNIONS = {
    "any": None,
    "none": (0.0, 0.0, 0.0, 0.0),
    "long": 1e9,
    "short": 1e-9,
    "identity": (1.0, 0, 0, 0),
}
OPACITIES = (1 - 1e-7, 1.0, 0.99, 0.985, 0.7, 0.1, 0.004, 1e-7, 1e-30, 0.0)
ASPECTS = (1.0, 1e-1, 1e-2, 1e-4, 1e-6)


@dataclass(frozen=True)
class Drawn:
    """One example: Gaussians (of values that float32 holds), a receiver, how it looks,
    in which precision.
    """

    scene: Scene
    pose: Pose
    grid: SphereGrid
    projection: str
    low_pass: float
    compensate: bool
    cutoff: Cutoff
    dtype: torch.dtype = torch.float32
    near: float = 0.05

    @property
    def optics(self) -> dict:
        """Keywords of `render`."""
        names = ("projection", "low_pass", "compensate", "cutoff", "near")
        return {name: getattr(self, name) for name in names}


@st.composite
def fields(draw, grids: st.SearchStrategy = GRIDS) -> Drawn:
    """Up to 8 Gaussians before one receiver a little off the origin."""
    noise = torch.Generator().manual_seed(draw(st.integers(0, 2**20)))
    count = draw(st.integers(0, 8))
    rows: list[tuple] = []
    for _ in range(count):
        if rows and draw(st.integers(0, 5)) == 0:
            rows.append(rows[-1])  # a repeated Gaussian
            continue
        direction = DIRECTIONS[draw(st.sampled_from(sorted(DIRECTIONS)))]
        axis = torch.randn(3, generator=noise) if direction is None else torch.tensor(direction)
        # The near cut, inside it, the fade, rooms, halls, a kilometre.
        distance = draw(st.sampled_from([0.0, 0.04, 0.06, 0.1, 1.0, 4.0, 60.0, 1e3]))
        mean = axis / axis.norm() * distance * (1 + 0.1 * torch.rand(1, generator=noise))
        size = draw(st.sampled_from([1e-6, 0.01, 0.3, 3.0])) * max(distance, 0.05)
        shape = torch.tensor([1.0, draw(st.sampled_from(ASPECTS)), draw(st.sampled_from(ASPECTS))])
        kind = QUATERNIONS[draw(st.sampled_from(sorted(QUATERNIONS)))]
        turn = torch.randn(4, generator=noise)
        if isinstance(kind, tuple):
            turn = torch.tensor(kind)
        elif kind is not None:
            turn = turn * kind
        rows.append((mean, turn, size * shape, draw(st.sampled_from(OPACITIES))))
    stack = lambda k, width: torch.stack([r[k] for r in rows]) if rows else torch.zeros(0, width)  # noqa: E731
    features = torch.randn(2, count, 1, generator=noise)
    ids = torch.randperm(1000, generator=noise)[:count]
    scene = (
        Scene(
            stack(0, 3), stack(1, 4), stack(2, 3), torch.tensor([r[3] for r in rows]), features, ids
        )
        .to(torch.float32)
        .to(torch.float64)
    )
    turn = torch.linalg.qr(torch.randn(3, 3, generator=noise, dtype=torch.float64))[0]
    turned = draw(st.booleans())
    rotation = (
        (turn * torch.linalg.det(turn).sign()).float().double() if turned else torch.eye(3).double()
    )
    place = (
        torch.zeros(3).double()
        if draw(st.booleans())
        else torch.randn(3, generator=noise).double() * 0.02
    )
    return Drawn(
        scene,
        Pose(place.float().double(), rotation),
        draw(grids),
        draw(st.sampled_from(["tangent", "equirect"])),
        draw(st.sampled_from([0.3, 0.3, 0.01, 0.0])),
        draw(st.booleans()),
        draw(st.sampled_from([Cutoff(), Cutoff(1e-3, 1e-4, relative=True), Cutoff(1e-6, 0.0)])),
        draw(st.sampled_from([torch.float32, torch.float64])),
    )


def show(drawn: Drawn, backend: str, **more) -> Outcome:
    """`render` in the precision drawn; the reference's truth is
    `show(exact(drawn), "reference")`.
    """
    return render(
        drawn.scene.to(drawn.dtype), drawn.pose, drawn.grid, backend, **drawn.optics, **more
    )


def exact(drawn: Drawn) -> Drawn:
    """The same in float64."""
    return replace(drawn, dtype=torch.float64)


def nudged(drawn: Drawn, seed: int) -> Drawn:
    """Every input moved by up to one unit of float32's rounding:
    vectors by that share of their length.
    """
    noise = torch.Generator().manual_seed(seed)

    def draws(shape: torch.Size) -> Tensor:
        return EPS["float32"] * (2 * torch.rand(shape, generator=noise).double() - 1)

    scene = drawn.scene
    moved = {name: getattr(scene, name) for name in ("means", "quats")}
    moved = {k: v + draws(v.shape) * v.norm(dim=-1, keepdim=True) for k, v in moved.items()}
    for name in ("scales", "opacities", "features"):
        value = getattr(scene, name)
        moved[name] = value * (1 + draws(value.shape))
    moved["opacities"] = moved["opacities"].clamp(0, 1)
    # Turned as a whole: the directions of the pixels are rounded too.
    x, y, z = draws(torch.Size([3])).tolist()
    turn = torch.tensor([[1, -z, y], [z, 1, -x], [-y, x, 1]], dtype=torch.float64)
    place = drawn.pose.position + draws(torch.Size([3])) * drawn.pose.position.norm()
    return replace(
        drawn, scene=replace(scene, **moved), pose=Pose(place, drawn.pose.rotation @ turn)
    )


@dataclass(frozen=True)
class Layers:
    """What each Gaussian is at each pixel, in float64: (N, H W), front to back.

    Attributes:
        order: (N,) Gaussians from front to back.
        strength: what is compared with the cut-off.
        most: its opacity before the clamp.
        light: what arrives at it.
        facing: cosine between pixel and Gaussian.
    """

    order: Tensor
    strength: Tensor
    most: Tensor
    light: Tensor
    facing: Tensor


def layers(drawn: Drawn) -> Layers:
    """The reference's own intermediate values."""
    optics, scene = Optics(**drawn.optics), drawn.scene
    seen = reference.project(scene.means, scene.quats, scene.scales, drawn.pose, drawn.grid, optics)
    order = reference.depth_order(seen, scene.ids)
    seen = reference.project(
        scene.means[order], scene.quats[order], scene.scales[order], drawn.pose, drawn.grid, optics
    )
    shapes = reference.footprints(seen, drawn.grid, optics, torch.zeros_like(scene.means[:, :2]))
    most = seen.gain[:, None] * scene.opacities[order, None] * shapes
    alpha = reference.layer_opacities(seen, shapes, scene.opacities[order], optics)
    light, _ = reference.transmittances(alpha, optics.cutoff.transmittance)
    directions = drawn.grid.directions().flatten(0, 1)
    return Layers(
        order,
        shapes if optics.cutoff.relative else most,
        most,
        light,
        seen.direction @ directions.mT,
    )


@dataclass(frozen=True)
class Condition:
    """How far a float32 input's rounding alone moves every output; measured in float64.

    Attributes:
        steady: (H, W) bool, no threshold is so near that rounding could cross it.
        moves: largest change of each output over `steady` pixels.
        truth: the outputs themselves.
        terms: number of terms of order 1 that a gradient sums; over the length of a quaternion for
            its own.
    """

    steady: Tensor
    moves: dict[str, float]
    truth: Outcome
    terms: dict[str, float]

    def allowed(self, name: str, precision: str, factor: float) -> float:
        """Bound on the error of output `name`: `factor` rounding errors of input,
        sums and result.
        """
        share = EPS[precision] / EPS["float32"]
        largest = float(self.truth[name].abs().max()) if self.truth[name].numel() else 0.0
        own = EPS[precision] * (1 + largest + self.terms.get(name, 0.0))
        return factor * (share * self.moves[name] + own)


_known: dict[bytes, Condition] = {}


def condition(drawn: Drawn, nudges: int = 3, **more) -> Condition:
    """Measure it by nudging, once for all backends; `more` goes to `render`."""
    parts = [v.numpy().tobytes() for v in vars(drawn.scene).values() if v is not None]
    parts += [drawn.pose.position.numpy().tobytes(), drawn.pose.rotation.numpy().tobytes()]
    parts += [repr((drawn.grid, drawn.optics, nudges, sorted(more))).encode()]
    key = hashlib.sha256(b"".join(parts)).digest()
    if key not in _known:
        _known[key] = _measure(drawn, nudges, **more)
    return _known[key]


def _measure(drawn: Drawn, nudges: int, **more) -> Condition:
    base, others = layers(drawn), [layers(nudged(drawn, seed)) for seed in range(nudges)]
    unsteady = torch.zeros(drawn.grid.height * drawn.grid.width, dtype=torch.bool)
    cut = drawn.cutoff
    for value, threshold in (
        ("strength", cut.alpha),
        ("most", ALPHA_MAX),
        ("light", cut.transmittance),
    ):
        here = getattr(base, value).clamp_min(1e-300).log()
        away = [(getattr(o, value).clamp_min(1e-300).log() - here).abs() for o in others]
        room = 8 * torch.stack([*away, torch.full_like(here, 256 * EPS["float32"])]).amax(0)
        unsteady |= ((here - math.log(max(threshold, 1e-300))).abs() <= room).any(0)
    if drawn.projection == "tangent":
        unsteady |= ((base.facing - HORIZON_COSINE).abs() < 1e-5).any(0)
    steady = ~unsteady.reshape(drawn.grid.height, drawn.grid.width)
    truth = show(exact(drawn), "reference", pixels=steady, **more)
    moves = dict.fromkeys(truth, 0.0)
    for seed in range(nudges):
        moved = show(exact(nudged(drawn, seed)), "reference", pixels=steady, **more)
        for name, value in truth.items():
            if name not in ("radii", "visible") and value.numel():
                gap = (moved[name] - value).abs()
                gap = gap[..., steady] if name in ("image", "transmittance") else gap
                moves[name] = max(moves[name], float(gap.max()) if gap.numel() else 0.0)
    lengths = drawn.scene.quats.norm(dim=1)
    shortest = (
        float(torch.where(lengths > SHORTEST_QUATERNION, lengths, 1.0).amin())
        if len(lengths)
        else 1.0
    )
    summed = float(steady.sum()) * len(drawn.scene.features)
    terms = {name: summed for name in truth if name.startswith("d_")} | {
        "d_quats": summed / shortest
    }
    return Condition(steady, moves, truth, terms)


def assert_within(got: Outcome, known: Condition, factor: float) -> None:
    """Every output within its bound, over steady pixels."""
    for name, want in known.truth.items():
        if name in ("radii", "visible") or not want.numel():
            continue
        gap = (got[name].double() - want).abs()
        gap = gap[..., known.steady] if name in ("image", "transmittance") else gap
        error = float(gap.max()) if gap.numel() else 0.0
        allowed = known.allowed(name, got.precision, factor)
        part = "backward" if name.startswith("d_") else "forward"
        relative = 1 + float(want.abs().max())
        LEDGER.compared(got.engine, got.precision, part, error / relative, allowed / relative)
        assert error <= allowed, (
            f"{name}: {error:.3g} beyond {allowed:.3g} (conditioning {known.moves[name]:.3g})"
        )
