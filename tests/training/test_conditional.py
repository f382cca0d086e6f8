import numpy as np
import pytest
import torch

from gsparc.training.conditional import leave_one_out_density


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
def test_the_density_of_left_out_rows_is_that_of_a_process_without_them(dtype):
    torch.manual_seed(0)
    mixing, target = torch.randn(9, 12, dtype=dtype), torch.randn(9, 2, dtype=dtype)
    covariance = mixing @ mixing.mH + 0.3 * torch.eye(9)
    found = leave_one_out_density(covariance, target)
    for row in range(9):
        rest = [other for other in range(9) if other != row]
        weights = torch.linalg.solve(covariance[rest][:, rest], covariance[rest, row])
        mean = weights.conj() @ target[rest]
        variance = float((covariance[row, row] - covariance[row, rest] @ weights).real)
        wanted = ((target[row] - mean).abs().square() / variance + np.log(variance)).mean() / 2
        assert torch.allclose(found[row], wanted.to(found.dtype))
