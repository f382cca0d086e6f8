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

    def _insertions(self, places: np.ndarray) -> np.ndarray:
        """What each of places (n, 2) adds to the walk before each stop, or at its end: (stops + 1, n) [m]."""
        stops = self._stops()
        count = len(stops)
        added = np.empty((count + 1, len(places)))
        for at in range(count + 1):
            before = stops[at - 1] if at > 0 else self.start
            after = stops[at] if at < count else None
            one = 0.0 if before is None else np.hypot(*(places - before).T)
            two = 0.0 if after is None else np.hypot(*(places - after).T)
            saved = 0.0 if before is None or after is None else float(np.hypot(*(after - before)))
            added[at] = one + two - saved
        return added

    def _shorter(self) -> list[int]:
        """The walk after turning stretches round (G. A. Croes, Oper. Res. 6 (1958)) while that helps."""
        walk = list(self._walk)
        for _ in range(ROUNDS):
            stops = np.array([self._places[k] for k in walk]).reshape(-1, 2)
            changed = False
            for i in range(len(walk) - 1):
                before = stops[i - 1] if i else self.start
                for j in range(i + 1, len(walk)):
                    after = stops[j + 1] if j + 1 < len(walk) else None
                    old = new = 0.0
                    if before is not None:
                        old, new = old + np.hypot(*(stops[i] - before)), new + np.hypot(*(stops[j] - before))
                    if after is not None:
                        old, new = old + np.hypot(*(after - stops[j])), new + np.hypot(*(after - stops[i]))
                    if new < old - 1e-9:
                        walk[i : j + 1] = walk[i : j + 1][::-1]
                        stops[i : j + 1] = stops[i : j + 1][::-1].copy()
                        changed = True
            if not changed:
                break
        return walk
