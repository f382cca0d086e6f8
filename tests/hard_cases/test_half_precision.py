"""Half precision: 1 - 1e-6 rounds to 1; opacities, transmittances,
logarithms and SSIM lose what they say.

Remedy: features, confidence and the closed-form start compute in float32 whatever autocast says
(gsparc/field/model.py, confidence.py, gsparc/models/splat/closed_form_start.py); float16 and
bfloat16 tensors are refused by the rasterizer. Shown: a run under bfloat16 autocast is finite and
ends within 1 % of float32's error.
"""

import numpy as np
import pytest
import torch
from campaigns import spectra
from contexts import trained
from rasters import GRIDS, origin, random_scene, render


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_the_rasterizer_refuses_half_precision(backend, dtype):
    with pytest.raises(TypeError, match="computes in float32 or float64, got means in"):
        render(random_scene(n=4).to(dtype), origin(), GRIDS["patch"], backend)


def fitted(folder, autocast: bool) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        method, data = trained(spectra(folder / "own.npz"), folder, 30)
        batch = data.batch(np.arange(8))
        mean = method.predict(batch).mean
    assert mean.dtype == torch.float32 and mean.isfinite().all()
    assert all(
        p.dtype == torch.float32 and p.isfinite().all() for p in method.fitted_model().parameters()
    )
    return mean, batch.target


def test_a_run_under_autocast_is_finite_and_close(tmp_path):
    (half, target), (full, _) = (fitted(tmp_path, autocast) for autocast in (True, False))
    errors = [float((mean - target).square().mean()) for mean in (half, full)]
    assert errors[0] == pytest.approx(errors[1], rel=0.01)
    assert float((half - full).abs().max()) < 0.05
