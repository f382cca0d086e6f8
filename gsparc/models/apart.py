"""The best of many that are unlike each other, chosen greedily."""

from __future__ import annotations

from collections.abc import Callable, Iterable


def keep_apart(
    order: Iterable[int], alike: Callable[[int, int], bool], limit: int | None = None
) -> list[int]:
    """Return numbers in their order, but those alike one that was kept before; at most `limit`.

    >>> keep_apart([9, 8, 5, 4, 1], lambda one, other: abs(one - other) < 2)
    [9, 5, 1]
    """
    numbers: list[int] = []
    for number in order:
        if len(numbers) == limit:
            break
        if not any(alike(number, other) for other in numbers):
            numbers.append(number)
    return numbers
