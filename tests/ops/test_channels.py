"""The kernel of factored channels against the sum written out in float64."""

import pytest
import torch
from torch.library import opcheck

from gsparc.ops import _native
from gsparc.ops.channels import channels, channels_backward_op, channels_op, summed

TONES = (2.4e9, 312_500.0)


def sources(samples, count, antennas, dtype=torch.float64, far=1e-7):
    draw = torch.Generator().manual_seed(count)
    gains = torch.randn(samples, count, 2, generator=draw, dtype=torch.float64).to(dtype)
    steering = torch.randn(count, antennas, 2, generator=draw, dtype=torch.float64).to(dtype)
    return gains, steering, far * torch.rand(count, generator=draw, dtype=torch.float64)


def evaluated(call, inputs, subcarriers, tones=TONES):
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = call(*leaves, subcarriers)
    slope = torch.linspace(-1, 2, out.numel(), dtype=torch.float64).reshape(out.shape).to(out.dtype)
    return out.detach().double(), *[g.double() for g in torch.autograd.grad(out, leaves, slope)]


@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("shape", [(1, 37, 4, 26), (3, 5, 1, 1), (2, 18, 3, 70), (2, 0, 2, 3)], ids=str)
def test_equals_the_sum(name, dtype, shape):
    *sizes, subcarriers = shape
    fastest = _native.instruction_set()
    if not _native.use_instruction_set(name):
        pytest.skip(f"this machine or build has no {name}")
    try:
        got = evaluated(lambda g, s, d, k: channels(g, s, d, *TONES, k), sources(*sizes, dtype), subcarriers)
    finally:
        _native.use_instruction_set(fastest)
    want = evaluated(lambda g, s, d, k: summed(g, s, d, TONES, k), sources(*sizes), subcarriers)
    tolerance = 1e-9 if dtype == torch.float64 else 1e-5
    for a, b in zip(got, want, strict=True):
        scale = float(b.abs().max()) if b.numel() else 1.0
        assert torch.allclose(a, b, rtol=0, atol=tolerance * (scale + 1))


def test_the_phase_survives_ten_kilometres_at_60_ghz():
    """10 km is two million turns: the recurrence starts from turns reduced in float64."""
    gains, steering = torch.tensor([[[1.0, 0.0]]]), torch.tensor([[[1.0, 0.0]]])
    delays = torch.tensor([1e4 / 299_792_458.0], dtype=torch.float64)
    got = torch.view_as_complex(channels(gains, steering, delays, 60e9, 120e3, 512))[0, 0]
    turns = (60e9 + 120e3 * torch.arange(512, dtype=torch.float64)) * delays
    want = torch.polar(torch.ones(512, dtype=torch.float64), -2 * torch.pi * turns.frac())
    assert (got - want).abs().max() < 1e-4
    naive = torch.polar(
        torch.ones(512), -2 * torch.pi * (60e9 + 120e3 * torch.arange(512.0)) * delays.float()
    )
    assert (naive - want).abs().max() > 0.1


def test_bit_identical_for_any_threads():
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            call = lambda g, s, d, k: channels(g, s, d, *TONES, k)  # noqa: E731
            results.append(evaluated(call, sources(2, 301, 5, torch.float32), 26))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


def test_operators_obey_the_rules():
    inputs = [tensor.requires_grad_() for tensor in sources(2, 3, 2)]
    opcheck(channels_op.defined, (*inputs, list(TONES), 3))
    plain = [tensor.detach() for tensor in inputs]
    opcheck(channels_backward_op.defined, (torch.ones(2, 2, 3, 2, dtype=torch.float64), *plain, list(TONES)))


def test_float32_delays_are_refused():
    gains, steering, delays = sources(1, 3, 2)
    with pytest.raises(TypeError, match="delays are float64"):
        channels(gains, steering, delays.float(), *TONES, 4)
    with pytest.raises(ValueError, match="are needed"):
        channels(gains, steering, delays[:2], *TONES, 4)


def test_half_precision_and_negative_counts_failed_in_the_words_of_a_library():
    gains, steering, delays = sources(1, 3, 2)
    with pytest.raises(TypeError, match="both float32 or both float64"):
        channels(gains.half(), steering.half(), delays, *TONES, 4)
    with pytest.raises(ValueError, match="-1 subcarriers are none"):
        channels(gains, steering, delays, *TONES, -1)
