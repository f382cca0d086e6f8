"""Propagation paths of many receivers as flat arrays, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsparc.simulate.effects import Effects


@dataclass(frozen=True)
class TracedPaths:
    """Paths of R receivers, sorted by receiver and then by delay;
    those of r are `offsets[r]:offsets[r+1]`.

    >>> receiver, delay = np.array([1, 0, 1]), np.array([2e-8, 1e-8, 1e-8])
    >>> count = np.zeros(3, np.uint8)
    >>> gain, direction = np.ones((3, 1), np.complex64), np.ones((3, 3))
    >>> paths = TracedPaths.from_unsorted(2, receiver, gain, delay, direction, count, count)
    >>> paths.offsets, paths.received_power()  # one path of the first receiver, two of the second
    (array([0, 1, 3]), array([1., 2.]))

    Attributes:
        offsets: (R + 1,) int64.
        gain: (P, ports) complex64 without the carrier's phase, one column per received
            polarisation.
        delay: (P,) float64 [s].
        direction: (P, 3) float32 unit vectors from the receiver to where the path comes from, world
            axes.
        mechanisms: (P,) uint8, OR of the bits of `effects.BITS` over its interactions; 0: line of
            sight.
        order: (P,) uint8 number of interactions.
    """

    offsets: np.ndarray
    gain: np.ndarray
    delay: np.ndarray
    direction: np.ndarray
    mechanisms: np.ndarray
    order: np.ndarray

    @staticmethod
    def from_unsorted(
        receivers: int,
        receiver_index: np.ndarray,
        gain: np.ndarray,
        delay: np.ndarray,
        direction: np.ndarray,
        mechanisms: np.ndarray,
        order: np.ndarray,
    ) -> TracedPaths:
        """Sort paths in any order; `receiver_index` (P,) says whose each is,
        the rest as of this class.
        """
        # The last key counts most: by receiver, then by delay.
        rank = np.lexsort((delay, receiver_index))
        offsets = group_offsets(np.bincount(receiver_index, minlength=receivers))
        return TracedPaths(
            offsets, *(array[rank] for array in (gain, delay, direction, mechanisms, order))
        )

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def receiver_index(self) -> np.ndarray:
        """Receiver of each path (P,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def power(self) -> np.ndarray:
        """|gain|^2 summed over the ports (P,)."""
        return (np.abs(self.gain.astype(np.complex128)) ** 2).sum(1)

    def select_paths(self, selected: np.ndarray) -> TracedPaths:
        """Return only the paths where `selected` (P,) bool is true; receivers stay."""
        counts = np.bincount(self.receiver_index[selected], minlength=len(self))
        return TracedPaths(
            group_offsets(counts), *(getattr(self, name)[selected] for name in ARRAYS)
        )

    def select_receivers(self, receivers: np.ndarray) -> TracedPaths:
        """Return receivers (n,) alone, in this order."""
        counts = np.diff(self.offsets)[receivers]
        # Rows of all paths without a loop: where a group begins here, less where it will begin.
        first = np.repeat(self.offsets[receivers] - group_offsets(counts)[:-1], counts)
        rows = first + np.arange(counts.sum())
        return TracedPaths(group_offsets(counts), *(getattr(self, name)[rows] for name in ARRAYS))

    def keep_effects(self, effects: Effects) -> TracedPaths:
        """Return what remains of a full simulation under these switches."""
        selected = self.select_paths(effects.allows_paths(self.mechanisms, self.order))
        return selected if effects.polarisation else replace(selected, gain=selected.gain[:, :1])

    def receiver_sums(self, values: np.ndarray) -> np.ndarray:
        """Return sums of `values` (P,) over the paths of each receiver (R,)."""
        return np.bincount(self.receiver_index, weights=values, minlength=len(self))

    def received_power(self) -> np.ndarray:
        """Return the mean power over a small area: the sum of path powers (R,)."""
        return self.receiver_sums(self.power)

    def delay_spread(self) -> np.ndarray:
        """Return the root-mean-square delay spread (R,) [s]; 0 where nothing arrives."""
        # Where nothing arrives 0 is divided by the least float64.
        total = np.maximum(self.received_power(), np.finfo(float).tiny)
        mean = self.receiver_sums(self.power * self.delay) / total
        return np.sqrt(
            self.receiver_sums(self.power * (self.delay - mean[self.receiver_index]) ** 2) / total
        )

    def responses(
        self, frequency_hz: np.ndarray, elements: np.ndarray, wavelength: float
    ) -> np.ndarray:
        """Return channels (R, ports x M, K) complex128:
        `sum_p a_p exp(-j 2 pi f tau_p) exp(+j k u_p . e_m)`.

        Args:
            frequency_hz: (K,) absolute frequencies [Hz].
            elements: (M, 3) [m] array elements about the receiver, world axes.
            wavelength: [m], at the carrier.
        """
        ports = self.gain.shape[1]
        channels = np.zeros(
            (len(self), ports * len(elements), len(frequency_hz)), dtype=np.complex128
        )
        for r, (start, stop) in enumerate(zip(self.offsets[:-1], self.offsets[1:], strict=True)):
            paths = slice(start, stop)
            # cycles, not radians, and reduced in float64 before the exponential
            tones = np.exp(-2j * np.pi * np.mod(np.outer(self.delay[paths], frequency_hz), 1.0))
            steered = np.exp(
                2j * np.pi / wavelength * (elements @ self.direction[paths].T.astype(np.float64))
            )
            for port in range(ports):
                block = (steered * self.gain[paths, port]) @ tones
                channels[r, port * len(elements) : (port + 1) * len(elements)] = block
        return channels


ARRAYS = ("gain", "delay", "direction", "mechanisms", "order")


def group_offsets(counts: np.ndarray) -> np.ndarray:
    """Return offsets (R + 1,) of consecutive groups of `counts` (R,) paths.

    >>> group_offsets(np.array([2, 0, 1]))
    array([0, 2, 2, 3])
    """
    return np.concatenate([[0], np.cumsum(counts)])


def join_receivers(parts: Sequence[TracedPaths]) -> TracedPaths:
    """Return receivers of all parts, one after the other."""
    counts = np.concatenate([np.diff(part.offsets) for part in parts])
    return TracedPaths(
        group_offsets(counts),
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS),
    )
