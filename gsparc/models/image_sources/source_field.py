"""Image sources as the Gaussians of a field: searches find mirror planes, gains are in closed form.

A Gaussian here is a virtual source, the image of the static end in a sequence of mirror planes, of which many
sources share each. The gains given the rows are those of `gp_likelihood`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.models.conditional import LeftOutRows
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.rows import gather
from gsparc.models.method_field import MethodField


class FramedField(MethodField):
    """What a method that is fitted in a frame found."""

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of one channel per receiver."""
        result: LeftOutRows = self.method.left_out()
        return result


class SourceField(FramedField):
    """The scenes of an ensemble of searches."""

    kind = "sources"
    makes = ImageSourceGP
    method: ImageSourceGP

    def __init__(self, method: ImageSourceGP) -> None:
        super().__init__(method)
        self.held = method.held

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
        planes = scene.planes.double()
        normal = planes[:, :3] / torch.linalg.vector_norm(planes[:, :3], dim=1, keepdim=True)
        moved = torch.cat([normal, planes[:, 3:] + (normal @ middle)[:, None]], 1)
        boxes = scene.clutter.boxes.double().view(-1, 2, 3) + middle
        return SiteObjects.of(moved.numpy(), boxes.numpy())

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; offsets of snapshots were estimated with the gains, which stay."""
        method = self.method
        if method.offsets != "none":
            return
        scenes = [member.scene for member in method.members]
        data = replace(data, target=data.target * method.factors.numpy()[:, None])
        method._conditioned(method.frame.inside(gather(data, rows, method.row_limit, method.seed)), scenes)


class RayField(FramedField):
    """Sources where measured directions of arrival meet; who sees one is measured, too."""

    kind = "rays"
    makes = DirectionalGP
    terms = ("phase", "visibility")  # type: ignore[assignment]
