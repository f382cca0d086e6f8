"""The compiled kernels; see csrc/bindings.cpp. Tensors are passed as addresses, 0 for an absent one."""

from collections.abc import Sequence

from gsparc.ops.settings import KernelSettings

RECORD: int
MOMENTS: int
STRIP_ROWS: int
UNSOUND_POSE: int
TILE_WIDTH: int
TILE_HEIGHT: int
SIMILARITY_WIDTH: int
SIMILARITY_HEIGHT: int
MOST_RADIUS: int
MOST_INPUTS: int
MOST_OUTPUTS: int

Ints = Sequence[int]
Reals = Sequence[float]

def plan(
    double: bool, poses: int, count: int, threads: int, settings: KernelSettings, tensors: Ints
) -> int: ...
def entries(double: bool, poses: int, count: int, threads: int, height: int, tensors: Ints) -> None: ...
def composite(
    double: bool,
    poses: int,
    count: int,
    threads: int,
    samples: int,
    channels: int,
    settings: KernelSettings,
    tensors: Ints,
) -> None: ...

composite_backward = composite

def weights(
    double: bool, poses: int, count: int, threads: int, settings: KernelSettings, tensors: Ints
) -> None: ...

weights_backward = weights

def freeze(double: bool, count: int, threads: int, settings: KernelSettings, tensors: Ints) -> int: ...
def thaw(double: bool, channels: int, height: int, width: int, threads: int, tensors: Ints) -> None: ...
def instruction_set() -> str: ...
def use_instruction_set(name: str) -> bool: ...
def mark_exponentials(tasks: int, threads: int) -> int: ...
def mark_copy(source: int, target: int, size: int, threads: int) -> None: ...
def mark_pairs(
    double: bool, poses: int, count: int, threads: int, settings: KernelSettings, tensors: Ints
) -> int: ...
def networks(double: bool, sizes: Ints, threads: int, tensors: Ints) -> None: ...

networks_backward = networks

def similarity(sizes: Ints, stability: Reals, threads: int, tensors: Ints) -> None: ...
def channels(double: bool, sizes: Ints, tones: Reals, threads: int, tensors: Ints) -> None: ...

channels_backward = channels
