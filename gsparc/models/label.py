"""One name for several fits of one method, of folds or of stations, that may approximate differently."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from gsparc.models.method import Method


def common_label(name: str, methods: Sequence[Method]) -> str:
    """Their label where they share one, else the most frequent: `gp (Vecchia 30 in 3 of 5)`."""
    found = Counter(method.label for method in methods)
    if not found:
        return name
    label, count = found.most_common(1)[0]
    inner = label.removeprefix(name).strip(" ()")
    return label if count == len(methods) or not inner else f"{name} ({inner} in {count} of {len(methods)})"
