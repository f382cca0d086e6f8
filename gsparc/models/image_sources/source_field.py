"""Image sources as the Gaussians of a field: mirror planes by gradient, gains in closed form.

A Gaussian here is a virtual source, the image of the static end in a sequence of mirror planes; what steps of
gradient move are the planes, of which many sources share each, and the sources' powers. The gains given the
rows are those of `gp_likelihood`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.schema import Batch, Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.rows import Rows, gather
from gsparc.models.image_sources.scene import correlations
from gsparc.models.method_field import MethodField
from gsparc.training.conditional import LeftOutRows, leave_one_out_density


class FramedField(MethodField):
    """What a method that is fitted in a frame found."""

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of one channel per receiver."""
        method, left = self.method, self.method.leave_one_out()
        rows = method.members[0].rows if isinstance(method, ImageSourceGP) else method.rows
        scale = (method.frame.carrier_hz / rows.frequency).float()[:, None] * method.frame.scale
        mean = (rows.target * scale - left.residual)[:, :, None]
        return LeftOutRows(left.rows, mean, torch.full((len(left.rows),), float("nan")))


class SourceField(FramedField):
    """The scenes of an ensemble of searches."""

    kind = "sources"
    makes = ImageSourceGP
    method: ImageSourceGP
    rates: ClassVar[dict[str, float]] = {"planes": 1e-4}  # [m] of a plane's offset, and of its unit normal

    def __init__(self, method: ImageSourceGP) -> None:
        super().__init__(method)
        self.held = method.held
        fixed = method.offsets != "none"  # those of every snapshot were estimated against these sources
        scenes = [] if fixed else [member.scene for member in method.members]
        self.planes = nn.ParameterList([scene.planes.clone() for scene in scenes])
        self.log_amplitudes = nn.ParameterList([scene.log_amplitude.clone() for scene in scenes])

    @property
    def terms(self) -> tuple[str, ...]:
        """Carrier phase, and visibility where it is modelled."""
        clutter = any(len(member.scene.clutter) for member in self.method.members)
        return ("phase", "visibility") if clutter else ("phase",)

    def objects(self) -> SiteObjects:
        """Planes and boxes of the heaviest search."""
        method = self.method
        scene = method.members[int(torch.as_tensor(method.weights).argmax())].scene
        middle = method.frame.middle.double()
        planes = scene.planes.detach().double()
        normal = planes[:, :3] / torch.linalg.vector_norm(planes[:, :3], dim=1, keepdim=True)
        moved = torch.cat([normal, planes[:, 3:] + (normal @ middle)[:, None]], 1)
        boxes = scene.clutter.boxes.detach().double().view(-1, 2, 3) + middle
        return SiteObjects.of(moved.numpy(), boxes.numpy())

    def loss(self, batch: Batch) -> Tensor:
        """See `ConditionalField.loss`; of every search by its weight, with circular gains."""
        rows = rows_of(self.method, batch)
        each = []
        for number, member in enumerate(self.method.members):
            scene = replace(
                member.scene,
                planes=self.planes[number],
                log_amplitude=self.log_amplitudes[number],
                phase=None,
            )
            seen = scene.visible_share(rows.position).detach()
            waves = scene.unobstructed(rows) * seen * scene.log_amplitude.exp()
            correlation = correlations(rows, scene.sources.detach(), scene.visibility)
            covariance = torch.einsum("nk,mk,knm->nm", waves, waves.conj(), correlation.to(waves.dtype))
            noise = float(np.exp(scene.log_noise)) + scene.noise_floor
            density = leave_one_out_density(covariance + noise * torch.eye(len(rows)), rows.target)
            each.append(density * self.method.weights[number])
        summed = torch.stack(each).sum(0)
        return summed.view(len(batch), -1).mean(1)

    @torch.no_grad()
    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`."""
        method = self.method
        if method.offsets != "none":
            return
        scenes = [
            replace(member.scene, planes=planes.detach().clone(), log_amplitude=amplitude.detach())
            for member, planes, amplitude in zip(
                method.members, self.planes, self.log_amplitudes, strict=True
            )
        ]
        data = replace(data, target=data.target * method.factors.numpy()[:, None])
        method._conditioned(method.frame.inside(gather(data, rows, method.row_limit, method.seed)), scenes)


class RayField(FramedField):
    """Sources where measured directions of arrival meet; who sees one is measured, too."""

    kind = "rays"
    makes = DirectionalGP
    terms = ("phase", "visibility")  # type: ignore[assignment]


def rows_of(method: ImageSourceGP, batch: Batch) -> Rows:
    """A batch as rows of the method's frame, one tone of each antenna."""
    places, _ = method._places(batch.tx, batch.rx)
    assert method.site is not None
    tones = torch.from_numpy(method.site.tones())
    count = len(batch)
    per = len(places) // count
    chosen = batch.index.cpu() % len(tones)  # all tones have their turn
    target = batch.target[torch.arange(count), :, chosen] * method.factors  # (B, A)
    target = target.reshape(-1, 1) if per > 1 else target
    frequency = tones[chosen].repeat_interleave(per)
    receiver = torch.arange(count).repeat_interleave(per)
    rows = Rows(places[:, :3] + method.frame.middle, frequency, target, receiver)
    if places.shape[1] > 3:
        rows = replace(rows, array=places[:per, 3:], element=torch.arange(per).repeat(count))
    return method.frame.inside(rows)
