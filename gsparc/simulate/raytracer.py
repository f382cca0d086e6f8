"""Sionna's ray tracer as an engine, with a check for each known failure;
Sionna is imported when it traces.

What is guarded: candidates cut off at the shared limit (detected, and the batch is halved and
traced again), specular chains lost to one another (a hash table large enough for a batch),
duplicated lines of sight (refused), materials without scattering (completed),
receivers inside objects.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsparc.data.schema import LIGHT
from gsparc.simulate import llvm
from gsparc.simulate.effects import Effects
from gsparc.simulate.loading import load_scene
from gsparc.simulate.paths import TracedPaths, join_receivers
from gsparc.simulate.sampling import Sampling, divide_into_calls
from gsparc.simulate.scenes.solid import Solid
from gsparc.simulate.scenes.transmitters import ISOTROPIC, Antenna
from gsparc.simulate.solver_paths import collect_paths
from gsparc.simulate.survey import TracingEngine

log = logging.getLogger(__name__)

CANDIDATES_PER_RECEIVER = 20_000
# Two tables of this, 512 MB; Sionna's own (1e6 at least)
# loses a tenth of the paths of 200 receivers.
HASHES = 64_000_000
GROUND_LEVEL = 0.7  # least share of the ground's area that is level
LARGEST_BUFFER = 8_000_000  # candidates of one call; about 300 bytes each


class RayTracer(TracingEngine):
    """One scene with one transmitter, ready to trace.

    Args:
        source: objects built in code, the name of one of Sionna's scenes, or the path of an XML
            file.
        transmitter, antenna: (3,) [m], and what it radiates.
        carrier_hz: [Hz].
        sampling: effort of the solver.
        scattering: scattering coefficient of all materials instead of `MATERIALS`; None for those.

    Attributes:
        scene: Sionna's (`sionna.rt.Scene`).

    Raises:
        SimulatorMissing: no Sionna, or no LLVM that works.
        ValueError: no such scene, or a file that Sionna cannot read.
    """

    name = "sionna-rt"
    random = True

    def __init__(
        self,
        source: Sequence[Solid] | str | Path,
        transmitter: np.ndarray,
        carrier_hz: float,
        sampling: Sampling = Sampling(),
        scattering: float | None = None,
        antenna: Antenna = ISOTROPIC,
    ) -> None:
        llvm.prepare_llvm()
        import drjit as dr

        dr.set_thread_count(torch.get_num_threads())  # of one thread alone the bits come again
        self.sampling = sampling
        self.wavelength = LIGHT / carrier_hz
        self.scene = load_scene(source, carrier_hz, scattering)
        self.transmitter, self.antenna = np.asarray(transmitter, dtype=np.float64), antenna
        # Antennas of the scene, shared by `with_transmitter`
        self._arrays: list[tuple[int, str]] = []
        self.retried = 0  # batches traced again because candidates were cut off
        # Enlargement of the candidate buffer by effects
        self._buffer_factor: dict[Effects, int] = {}

    def with_transmitter(self, transmitter: np.ndarray, antenna: Antenna) -> RayTracer:
        """Return the same scene with the transmitter elsewhere."""
        other = copy(self)
        other.transmitter, other.antenna = np.asarray(transmitter, dtype=np.float64), antenna
        return other

    def with_samples(self, samples: int) -> RayTracer:
        """Return the same scene with so many rays of a call."""
        other = copy(self)
        other.sampling = replace(self.sampling, samples=samples)
        return other

    def package_versions(self) -> dict[str, str]:
        """Return versions of the solver's packages."""
        from importlib.metadata import version

        return {name: version(name) for name in ("sionna-rt", "mitsuba", "drjit")}

    def materials(self) -> dict[str, dict[str, Any]]:
        """Return ITU name, thickness [m] and scattering coefficient of every material in use."""
        return {
            name: {
                "itu": getattr(m, "itu_type", None),
                "thickness_m": round(float(m.thickness[0]), 6),
                "scattering": round(float(m.scattering_coefficient[0]), 6),
                "permittivity": round(float(m.relative_permittivity[0]), 6),
            }
            for name, m in self.scene.radio_materials.items()
        }

    def radio_materials(self) -> dict[str, Any]:
        """Return Sionna's materials (`sionna.rt.RadioMaterial`) of the scene's objects, by name."""
        used = {thing.radio_material.name for thing in self.scene.objects.values()}
        return {
            name: radio_material
            for name, radio_material in self.scene.radio_materials.items()
            if name in used
        }

    def trace(
        self, receivers: np.ndarray, effects: Effects, seed: int | None = None
    ) -> TracedPaths:
        """Trace paths to receivers (R, 3) [m], world; `seed` in place of `sampling.seed`.

        Raises:
            RuntimeError: a receiver has several lines of sight, or one alone has more candidates
                than fit.
        """
        # How many receivers a call has is a constant of its kernels:
        # any other number compiles them anew.
        beneath = np.append(self.transmitter[:2], self._lowest - 1.0)
        parts, first = [], 0
        for count, size in divide_into_calls(len(receivers), self.sampling.batch):
            filled = np.concatenate(
                [receivers[first : first + count], np.tile(beneath, (size - count, 1))]
            )
            solved = self.trace_in_batches(filled, effects, seed)
            ports = 2 if effects.polarisation else 1
            part = join_receivers(
                [collect_paths(solution, number, ports) for solution, number in solved]
            )
            parts.append(part.select_receivers(np.arange(count)))
            first += count
        return join_receivers(parts)

    def trace_in_batches(
        self, receivers: np.ndarray, effects: Effects, seed: int | None = None
    ) -> Iterator[tuple[Any, int]]:
        """Yield Sionna's own paths (`sionna.rt.Paths`) of consecutive receivers, and of how many.

        The scene holds these receivers until the next is asked for.
        Arguments and errors as of `trace`.
        """
        rays, size = self.sampling.seed if seed is None else seed, self.sampling.batch
        for first in range(0, len(receivers), size):
            yield from self._batch(receivers[first : first + size], effects, rays)

    def _batch(
        self, receivers: np.ndarray, effects: Effects, seed: int
    ) -> Iterator[tuple[Any, int]]:
        """One call; halved, or with a larger buffer, when candidates were cut off."""
        boost = self._buffer_factor.get(effects, 1)
        # A full batch's whatever the size: the limit is a constant of the kernel,
        # another compiles it anew.
        batch = max(self.sampling.batch, len(receivers))
        limit = min(CANDIDATES_PER_RECEIVER * boost * batch, LARGEST_BUFFER)
        solution = self._solve(receivers, effects, seed, limit)
        if solution is not None:
            yield solution, len(receivers)
            return
        self.retried += 1
        if limit < LARGEST_BUFFER:
            log.info(
                "candidate paths were cut off at %d; tracing %d receivers again",
                limit,
                len(receivers),
            )
            # Kept by effects: later batches begin with the buffer that this one needed.
            self._buffer_factor[effects] = boost * 4
            yield from self._batch(receivers, effects, seed)
            return
        if len(receivers) == 1:
            raise RuntimeError(
                f"one receiver has over {LARGEST_BUFFER} candidate paths; lower sampling.samples"
            )
        half = len(receivers) // 2
        log.info(
            "candidate paths were cut off at %d; tracing halves of %d receivers",
            limit,
            len(receivers),
        )
        for part in (receivers[:half], receivers[half:]):
            yield from self._batch(part, effects, seed)

    def _solve(self, receivers: np.ndarray, effects: Effects, seed: int, limit: int) -> Any | None:
        """Sionna's paths, or None when the solver ran into `limit` and left some out."""
        import sionna.rt as rt
        from sionna.rt.path_solvers import sb_candidate_generator as shooting

        self._place_ends(receivers, 2 if effects.polarisation else 1)
        # Chains of all receivers of a call share the table; collisions are dropped silently.
        shooting.SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = HASHES
        shooting.fibonacci_lattice = _lattice
        solver = rt.PathSolver()
        generate, stored = solver._candidate_generator, list[Any]()

        def counted(**arguments: Any) -> Any:
            """Keep how many candidates there are, which the solver does not report."""
            buffer = generate(**arguments)
            stored.append(buffer.paths_counter)
            return buffer

        solver._candidate_generator = counted
        solution = solver(
            self.scene,
            max_depth=effects.depth,
            samples_per_src=self.sampling.samples,
            max_num_paths_per_src=limit,
            los=effects.line_of_sight,
            specular_reflection=effects.specular,
            diffuse_reflection=effects.diffuse,
            refraction=effects.refraction,
            diffraction=effects.diffraction,
            edge_diffraction=effects.edge_diffraction,
            seed=seed,
        )
        return None if int(stored[-1].numpy().max()) >= limit else solution

    def _place_ends(self, receivers: np.ndarray, ports: int) -> None:
        """Place transmitter and receivers in the scene."""
        import drjit as dr
        import mitsuba as mi
        import sionna.rt as rt

        scene, wanted = self.scene, (ports, self.antenna.pattern)
        if self._arrays != [wanted]:

            def one(pattern: str, polarisation: str) -> Any:
                return rt.PlanarArray(
                    num_rows=1, num_cols=1, pattern=pattern, polarization=polarisation
                )

            scene.tx_array = one(self.antenna.pattern, "V")
            scene.rx_array = one("iso", "V" if ports == 1 else "VH")
            self._arrays[:] = [wanted]
        for name in list(scene.receivers):
            scene.remove(name)
        if not scene.transmitters:
            scene.add(rt.Transmitter("tx", position=mi.Point3f(0, 0, 0)))

        def point(coordinates: np.ndarray) -> Any:
            # Plain numbers are constants of kernels: every other place would compile one anew.
            opaque = mi.Point3f(*map(float, coordinates))
            dr.make_opaque(opaque)
            return opaque

        tx = scene.get("tx")
        tx.position, ahead = point(self.transmitter), point(np.zeros(3))
        tx.orientation = point(
            np.radians([self.antenna.azimuth_deg, self.antenna.downtilt_deg, 0.0])
        )
        for i, place in enumerate(receivers):
            scene.add(rt.Receiver(f"rx{i}", position=point(place), orientation=ahead))

    def under_open_sky(self, points: np.ndarray) -> np.ndarray:
        """Tell whether nothing is above points (N, 3) [m]:
        outdoors that means outside of buildings.
        """
        return ~np.isfinite(self._hit(points, np.array([0.0, 0.0, 1.0])).t.numpy())

    def clear_of_surfaces(self, points: np.ndarray, gap: float) -> np.ndarray:
        """Tell whether no surface is within `gap` [m] of points (N, 3) along the six axes."""
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        return np.all([self._hit(points, axis).t.numpy() > gap for axis in axes], axis=0)

    def triangles(self) -> np.ndarray:
        """Return triangles (n, 3, 3) [m] of all objects."""
        return np.concatenate([*self._objects().values()])

    def bounding_box(self) -> np.ndarray:
        """Return lower and upper corner (2, 3) [m] of everything."""
        corners = self.triangles().reshape(-1, 3)
        return np.stack([corners.min(0), corners.max(0)])

    @cached_property
    def _lowest(self) -> float:
        return float(self.bounding_box()[0, 2])

    def _objects(self) -> dict[str, np.ndarray]:
        """Triangles (n, 3, 3) of each object."""
        triangles = {}
        for name, thing in self.scene.objects.items():
            vertices = thing.mi_mesh.vertex_positions_buffer().numpy().reshape(-1, 3)
            triangles[name] = vertices[thing.mi_mesh.faces_buffer().numpy().reshape(-1, 3)].astype(
                np.float64
            )
        return triangles

    def highest_surface(self, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the highest surface (n,) [m] at (n, 2) [m], -inf without one,
        and whether it is ground.

        The ground is the widest object whose area is mostly level; without one all is.
        """
        import mitsuba as mi

        # From a metre above everything, so that rays start outside of all objects.
        top = self.bounding_box()[1, 2] + 1.0
        above = np.column_stack([across, np.full(len(across), top)])
        hit = self._hit(above, np.array([0.0, 0.0, -1.0]))
        ground, height = self._ground(), top - hit.t.numpy().astype(np.float64)
        if ground is None:
            return height, np.isfinite(height)
        # Mitsuba compares shapes by pointer.
        shape = mi.ShapePtr(self.scene.objects[ground].mi_mesh)
        return height, (hit.shape == shape).numpy()

    def surface_height(self, across: np.ndarray) -> np.ndarray:
        """Return the highest surface (n,) [m] at places (n, 2) [m], -inf where there is none."""
        return self.highest_surface(across)[0]

    def _ground(self) -> str | None:
        level = {}  # area of each object that is mostly level
        for name, corners in self._objects().items():
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            # Cross products are twice the areas; their vertical parts are areas seen from above.
            size = float(np.abs(normal[:, 2]).sum())
            if size > GROUND_LEVEL * np.linalg.norm(normal, axis=1).sum():
                level[name] = size
        return max(level, key=level.__getitem__, default=None)

    def has_open_sky(self, area: np.ndarray) -> bool:
        """Tell whether an area (2, 2) [m] is not closed by a ceiling: seen from above,
        some of it is low.

        Raises:
            ValueError: nothing of the scene is in the area.
        """
        low, top = self.bounding_box()[:, 2]
        height = self.surface_height(
            np.random.default_rng(0).uniform(area[0], area[1], size=(500, 2))
        )
        heights = height[np.isfinite(height)]
        if not len(heights):
            raise ValueError(
                f"scene.area_m={area.tolist()}: nothing of the scene is there; say another"
            )
        return bool((heights < (low + top) / 2).mean() > 0.05)

    def _hit(self, points: np.ndarray, direction: np.ndarray) -> Any:
        import mitsuba as mi

        origin = mi.Point3f(
            *(mi.Float(np.ascontiguousarray(points[:, i], dtype=np.float32)) for i in range(3))
        )
        ray = mi.Ray3f(origin, mi.Vector3f(*map(float, direction)))
        return self.scene.mi_scene.ray_intersect(ray)


def _lattice(points: int) -> Any:
    """Sionna's, evaluated: else the number of rays is a constant of the largest kernel."""
    import drjit as dr
    from sionna.rt.utils.fibonacci import fibonacci_lattice

    lattice = fibonacci_lattice(points)
    dr.eval(lattice)
    return lattice
