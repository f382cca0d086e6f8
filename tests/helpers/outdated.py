"""Stored checkpoints of earlier versions that are refused today, and what the refusal says."""

from __future__ import annotations

PACKETS = ["array", "gsparc_array", "gsparc_array_beside", "traded_array"]  # made of wave packets
COMPANIONS = ["gsparc_phase_rest", "gsparc_phase_told", "gsparc_phase_told_rest", "traded_phase_rest"]
GONE = {
    **dict.fromkeys(PACKETS, "it is made of wave packets, as earlier versions were; train"),
    **dict.fromkeys(COMPANIONS, "it has a companion of an earlier version; train"),
    "nerf2": "its networks are of an earlier form than the published one; train",
    "gsparc_splat_phase": "its carrier phase is of splatted Gaussians, as in earlier versions; train",
}
