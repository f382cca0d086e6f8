"""The compiled kernels; see csrc/bindings.cpp. Tensors are passed as addresses, 0 for an absent one."""

from collections.abc import Sequence

RECORD: int
MOMENTS: int
STRIP_ROWS: int

Ints = Sequence[int]
Reals = Sequence[float]

def plan(
    twice: bool, poses: int, count: int, threads: int, whole: Ints, real: Reals, tensors: Ints
) -> int: ...
def entries(twice: bool, poses: int, count: int, threads: int, height: int, tensors: Ints) -> None: ...
def composite(
    twice: bool,
    poses: int,
    count: int,
    samples: int,
    channels: int,
    threads: int,
    whole: Ints,
    real: Reals,
    tensors: Ints,
) -> None: ...
def composite_backward(
    twice: bool,
    poses: int,
    count: int,
    samples: int,
    channels: int,
    threads: int,
    whole: Ints,
    real: Reals,
    tensors: Ints,
) -> None: ...
def weights(
    twice: bool, poses: int, count: int, threads: int, whole: Ints, real: Reals, tensors: Ints
) -> None: ...
def weights_backward(
    twice: bool, poses: int, count: int, threads: int, whole: Ints, real: Reals, tensors: Ints
) -> None: ...
def freeze(twice: bool, count: int, threads: int, whole: Ints, real: Reals, tensors: Ints) -> int: ...
def thaw(twice: bool, height: int, width: int, channels: int, threads: int, tensors: Ints) -> None: ...
def instruction_set() -> str: ...
def use_instruction_set(name: str) -> bool: ...
def mark_exponentials(tasks: int, threads: int) -> int: ...
def mark_copy(source: int, target: int, size: int, threads: int) -> None: ...
def mark_pairs(
    twice: bool, poses: int, count: int, threads: int, whole: Ints, real: Reals, tensors: Ints
) -> int: ...
def networks(twice: bool, sizes: Ints, threads: int, tensors: Ints) -> None: ...
def networks_backward(twice: bool, sizes: Ints, threads: int, tensors: Ints) -> None: ...
def similarity(sizes: Ints, stability: Reals, threads: int, tensors: Ints) -> None: ...
