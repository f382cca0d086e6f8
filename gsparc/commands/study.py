"""`gsparc study kind=effects|positions|measurements`: a multirun of trainings, of variants of a
model or of errors of the data.
"""

from __future__ import annotations

from gsparc.commands.train import task as task
