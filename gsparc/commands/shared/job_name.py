"""Names of the folders of a sweep's jobs: their overrides, short enough for a file system.

Importing this module makes `${gsparc_job_name:OVERRIDES,UNNAMED}` known to configurations.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from omegaconf import OmegaConf

MOST = 160  # bytes; a name of 255 is the most that file systems take, and its job's number comes first
DIGEST = 8  # characters


def job_name(overrides: Sequence[str], unnamed: Sequence[str] = ()) -> str:
    """`model.field.count-40_seed-0`; where that is too long, last words of keys and a digest of the whole.

    A path among the values makes no folders within the folder.

    Args:
        overrides: of one job, as `key=value`.
        unnamed: keys that are left out.
    """
    split = [one.partition("=") for one in sorted(overrides)]
    pairs = [(key, value.replace("/", "+")) for key, _, value in split if key not in unnamed]
    whole = "_".join(f"{key}-{value}" for key, value in pairs)
    if len(whole.encode()) <= MOST:
        return whole
    short = "_".join(f"{key.rpartition('.')[2]}-{value}" for key, value in pairs)
    start = short.encode()[: MOST - DIGEST - 1].decode(errors="ignore")
    return f"{start}~{hashlib.sha256(whole.encode()).hexdigest()[:DIGEST]}"


OmegaConf.register_new_resolver("gsparc_job_name", job_name, replace=True)
