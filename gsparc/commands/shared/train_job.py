"""Training as a job of a list: with data that were read before, in short."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from gsparc.commands.shared.inputs import read_inputs
from gsparc.commands.train import train
from gsparc.evaluation.experiment.runner import Job
from gsparc.models.array_vectors.vector_cache import forget_vectors


def train_job(job: Job, left: str | None) -> None:
    """Train a job into its folder, from what an interrupted try has `left` there."""
    config = deepcopy(job.config)
    forget_vectors()  # solved for another job, they would be missing from this one's processor seconds
    # What the settings name to go on from wins.
    config.ckpt_path = config.ckpt_path or left
    inputs = replace(read_inputs(config, job.data), split=job.split, learned=job.learned)
    _, made = train(config, job.folder, inputs, in_full=False)
    for file in () if job.keeps_models else made.checkpoints:
        file.unlink()
