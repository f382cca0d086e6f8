"""A short walk through places: cheapest insertion, then turns of stretches as long as one is shorter."""

from __future__ import annotations

import numpy as np

ROUNDS = 50


class Tour:
    """An open walk that grows place by place.

    Args:
        start: (2,) where it starts [m]; None: at whichever place.
        longest: metres it may have; None: any.
    """

    def __init__(self, start: np.ndarray | None, longest: float | None) -> None:
        self.start, self.longest = start, longest
        self._places: list[np.ndarray] = []  # as they were added
        self._walk: list[int] = []  # their numbers in the order of the walk

    def within(self, places: np.ndarray) -> np.ndarray:
        """Which of places (n, 3) can be added, (n,) bool."""
        if self.longest is None:
            return np.ones(len(places), bool)
        return self._insertions(places[:, :2]).min(axis=0) + self._length() <= self.longest

    def add(self, place: np.ndarray) -> None:
        """Put a place (3,) where it lengthens the walk least."""
        at = int(self._insertions(place[None, :2])[:, 0].argmin())
        self._places.append(place[:2])
        self._walk.insert(at, len(self._places) - 1)
        if self.longest is not None:
            self._walk = self._shorter()

    def order(self) -> np.ndarray:
        """Numbers (n,) int64 of the places, as they were added, in the order of the walk."""
        return np.array(self._shorter(), np.int64)

    @staticmethod
    def length_of(places: np.ndarray, start: np.ndarray | None) -> float:
        """Of a walk through places (n, 2 or 3) in their order [m]."""
        stops = places[:, :2] if start is None else np.vstack([start, places[:, :2]])
        return float(np.hypot(*np.diff(stops, axis=0).T).sum()) if len(stops) > 1 else 0.0

    def _stops(self) -> np.ndarray:
        return np.array([self._places[k] for k in self._walk]).reshape(-1, 2)

    def _length(self) -> float:
        return self.length_of(self._stops(), self.start)

    def _ends(self, stops: np.ndarray) -> np.ndarray:
        """Stops (n + 2, 2) with what is before and after them; NaN where there is nothing."""
        nothing = np.full(2, np.nan)
        return np.vstack([nothing if self.start is None else self.start, stops, nothing])

    def _insertions(self, places: np.ndarray) -> np.ndarray:
        """What each of places (n, 2) adds to the walk before each stop, or at its end: (stops + 1, n) [m]."""
        stops = self._ends(self._stops())
        to = _apart(stops[:, None], places)
        return to[:-1] + to[1:] - _apart(stops[:-1], stops[1:])[:, None]

    def _shorter(self) -> list[int]:
        """The walk after turning stretches round (G. A. Croes, Oper. Res. 6 (1958)) while that helps."""
        stops = self._ends(np.array(self._places).reshape(-1, 2))
        apart = _apart(stops[:, None], stops)
        walk = [0, *(k + 1 for k in self._walk), len(stops) - 1]  # rows of `stops`
        for _ in range(ROUNDS):
            before = list(walk)
            for i in range(1, len(walk) - 2):
                for j in range(i + 1, len(walk) - 1):
                    a, b, c, d = walk[i - 1], walk[i], walk[j], walk[j + 1]
                    if apart[a, c] + apart[b, d] < apart[a, b] + apart[c, d] - 1e-9:
                        walk[i : j + 1] = walk[i : j + 1][::-1]
            if walk == before:
                break
        return [k - 1 for k in walk[1:-1]]


def _apart(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Distances of places (..., 2) [m]; 0 to nothing, which is NaN."""
    return np.nan_to_num(np.hypot(*np.moveaxis(one - two, -1, 0)))
