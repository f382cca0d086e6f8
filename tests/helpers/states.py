"""States of models and optimizers, compared."""

import torch


def different(a: object, b: object, where: str = "state") -> list[str]:
    """Places at which two nested states are not bit-identical."""
    if isinstance(a, torch.Tensor):
        return [] if a.dtype == b.dtype and torch.equal(a, b) else [where]
    if isinstance(a, dict) and a.keys() == b.keys():
        return [place for key in a for place in different(a[key], b[key], f"{where}.{key}")]
    if isinstance(a, (list, tuple)) and len(a) == len(b):
        pairs = enumerate(zip(a, b, strict=True))
        return [place for i, (x, y) in pairs for place in different(x, y, f"{where}[{i}]")]
    return [] if a == b else [where]


def same(a: object, b: object) -> bool:
    """Whether two nested states hold the same bits."""
    return not different(a, b)
