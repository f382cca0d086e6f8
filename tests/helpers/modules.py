"""A small LightningModule around a field with hidden layers."""

import torch

from gsparc.field.confidence import ConfidenceSettings
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.losses import LossSettings
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
from gsparc.field.module import GaussianModule
from gsparc.field.optimizer import OptimizerSettings
from gsparc.ops import Pose

RECEIVER = Pose.identity(torch.tensor([4.0, 0.0, 0.0]))


def module(data, run_dir, confidence: bool = True) -> GaussianModule:
    torch.manual_seed(0)
    emission = EmissionSettings(
        EncodingSettings("raw"), hidden=3, activation="linear", init_bias=0.0
    )
    settings = ModelSettings(
        field=FieldSettings(count=20, placement="uniform"),
        emission=emission,
        attenuation=AttenuationSettings(inverse_distance=True),
        confidence=ConfidenceSettings(enabled=confidence),
    )
    shape = data.target.shape[1:] if data.site.kind == "csi" else None
    ends = (
        (RECEIVER, None) if data.site.static_end == "rx" else (None, torch.tensor([4.0, 0.0, 0.0]))
    )
    model = GaussianModel(settings, data.site, *ends, shape=shape)
    made = GaussianModule(model, LossSettings(0.0), OptimizerSettings(), 10, run_dir)
    made.log = lambda *a, **k: None  # type: ignore[method-assign]
    return made
