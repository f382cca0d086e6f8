"""Where training begins: random weights, a read-out in closed form, or what an initialiser finds."""

from __future__ import annotations

from functools import partial

from gsparc.field.initial import InitTask, Start, unchanged
from gsparc.models.array_vectors.splat_init import ThroughArray
from gsparc.models.splat.closed_form import learn_prior, learn_process, warm_start


def prepare(task: InitTask) -> Start:
    """The start of a task.

    Raises:
        ValueError: a start is asked for that the data do not allow.
    """
    if task.settings.response.array and task.closed_form:
        return ThroughArray()(task)
    if task.closed_form:
        assert task.receiver is not None  # else `auto_settings` refuses
        process = learn_process(task.data, task.rows, task.anchors, task.seed)
        solve = partial(warm_start, data=task.data, rows=task.rows, receiver=task.receiver, process=process)
        return Start(process.prior, solve)
    kernel = "kernel" in (task.settings.emission.encoding.kind, task.settings.confidence.encoding.kind)
    prior = learn_prior(task.data, task.rows, task.anchors, task.seed) if kernel else None
    return Start(prior, unchanged)
