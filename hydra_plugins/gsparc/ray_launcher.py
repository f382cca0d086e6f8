"""`hydra/launcher=ray`: jobs of a multirun on Ray. Hydra looks for launchers in `hydra_plugins`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, configure_log, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, open_dict


class RayLauncher(Launcher):
    """A job has `threads` cores, one where these are null;
    `workers` and `address` are as of `engine=ray`.
    """

    def __init__(self, workers: int | None = None, address: str | None = None) -> None:
        self.workers, self.address = workers, address

    def setup(self, **given: Any) -> None:
        """Take Hydra's `hydra_context`, `task_function` and `config`."""
        self.given = given

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> list[JobReturn]:
        """Do the jobs; one that fails leaves the others alone,
        one whose process dies is begun again.
        """
        import torch  # seconds, and Hydra imports all launchers whatever is chosen

        from gsparc.base import executor

        task, context, sweep = (self.given[k] for k in ("task_function", "hydra_context", "config"))
        configure_log(sweep.hydra.hydra_logging, sweep.hydra.verbose)
        Path(sweep.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        jobs = []
        for number, overrides in enumerate(job_overrides, initial_job_idx):
            jobs.append(context.config_loader.load_sweep_config(sweep, list(overrides)))
            with open_dict(jobs[-1]):
                jobs[-1].hydra.job.id = jobs[-1].hydra.job.num = number
        state = Singleton.get_state()

        def done(job: DictConfig) -> JobReturn:
            # A worker is another process: Hydra's resolvers and singletons are not there yet.
            setup_globals()
            Singleton.set_state(state)
            return run_job(task, job, "hydra.sweep.dir", "hydra.sweep.subdir", context)

        # Workers take over this process's number of threads, and count as so many cores.
        torch.set_num_threads(jobs[0].get("threads") or 1)
        executor.use_engine(executor.Engine("ray", self.workers, self.address))
        results = dict(executor.run_each(done, jobs, "jobs"))
        return [results[number] for number in range(len(jobs))]


target = {
    "_target_": f"{RayLauncher.__module__}.{RayLauncher.__name__}",
    "workers": None,
    "address": None,
}
ConfigStore.instance().store(group="hydra/launcher", name="ray", node=target, provider="gsparc")
