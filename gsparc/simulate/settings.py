"""Everything a simulated dataset is made from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from gsparc.base.limits import Checked, choice, setting, whole
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.effects import Effects
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.settings import SceneSettings
from gsparc.simulate.spectrum import ArraySettings, SpectrumSettings


@dataclass(frozen=True)
class CampaignSettings(Checked):
    """One dataset.

    Attributes:
        scene: where.
        effects: what is simulated; until that is decided, how `auto` does.
        sampling: how hard the ray tracer works.
        spectrum, csi: what is stored.
        shard: receivers per shard.
        check: receivers of the convergence error; 0 for none.
        measurement: which of `spectrum` and `csi` the file is mainly read as.
    """

    scene: SceneSettings
    effects: Effects | AutoSettings
    sampling: Sampling = field(default_factory=Sampling)
    spectrum: SpectrumSettings = field(default_factory=SpectrumSettings)
    csi: ArraySettings = field(default_factory=ArraySettings)
    shard: int = setting(400, whole(1))
    check: int = setting(128, whole(0))
    measurement: str = setting("spectrum", choice("spectrum", "csi"))

    @property
    def decided(self) -> Effects:
        """What is simulated, once `auto` has decided where it is to."""
        assert isinstance(self.effects, Effects)
        return self.effects

    def inputs(self) -> dict[str, str]:
        """Return the SHA-256 of the files that a scene and its receivers are read from."""
        # By their contents, so that an edited map does not go on with the shards of the old one.
        files = (self.scene.file, self.scene.xml, (self.scene.receivers or {}).get("file"))
        return {
            str(file): hashlib.sha256(Path(file).read_bytes()).hexdigest()
            for file in files
            if file is not None and Path(file).is_file()
        }
