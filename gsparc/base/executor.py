"""Where independent pieces of work are done: in this process, in several of this machine (joblib),
on Ray.

Work is stored by what it does, and looks for what is stored first: a piece that is begun again,
because the process that did it has died or the command was interrupted, is then not computed again.
"""

from __future__ import annotations

import logging
import os
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, TypeVar

import cloudpickle
import joblib
import torch
from joblib.externals.loky.process_executor import BrokenProcessPool
from threadpoolctl import threadpool_limits

from gsparc.base.errors import explain_error
from gsparc.base.limits import Checked, SettingError, choice, or_null, setting, whole

log = logging.getLogger(__name__)

SAY_S = 5.0  # between lines about progress, at least
LINES = 4  # about progress, more or less
TRIES = 3  # of a piece whose process dies
_Piece = TypeVar("_Piece")
_Result = TypeVar("_Result")
Results = Generator[tuple[int, Any], None, None]


@dataclass(frozen=True)
class Engine(Checked):
    """Where pieces are done.

    Attributes:
        engine: `process`, `joblib` or `ray`.
        workers: processes at once; None: as many as have `threads` cores each.
        address: of a Ray cluster, HOST:PORT or `auto`; None: one that is started on this machine.
    """

    engine: str = setting("process", choice("process", "joblib", "ray"))
    workers: int | None = setting(None, or_null(whole(1)))
    address: str | None = None


_chosen = Engine()


def use_engine(engine: Engine) -> None:
    """Choose it for this process, or `SettingError`: Ray is not there."""
    global _chosen
    if engine.engine == "ray":
        _ray()
    _chosen = engine


def uses_other_processes() -> bool:
    """Tell whether pieces are done in other processes."""
    return _chosen.engine != "process"


def run_each(
    work: Callable[[_Piece], _Result],
    pieces: Sequence[_Piece],
    what: str = "",
    *,
    cost: Callable[[_Piece], float] = lambda piece: 1.0,
    wanted: Callable[[_Piece], bool] = lambda piece: True,
    threads: int = 1,
) -> Iterator[tuple[int, _Result]]:
    """Yield numbers of pieces and what `work` makes of them, as they end; in order in this process.

    Work and pieces are pickled for other processes, work once for each;
    these have the threads of this one.

    Args:
        work, pieces: independent of one another.
        what: pieces are called in the log, which says after each how many are left and how long;
            "": no log.
        cost: of a piece beside the others, for the time left.
        wanted: asked when a piece would begin; others are left out.
        threads: of this process that do pieces side by side where no other process does.

    Raises:
        Exception: the first that `work` raises; pieces that have begun are cancelled.
        BrokenProcessPool, ray.exceptions.RayError: a piece ended its process `TRIES` times.
    """
    costs = [cost(piece) for piece in pieces]
    backlog, spent = Counter(costs), defaultdict[float, list[float]](list)
    numbers = (number for number, piece in enumerate(pieces) if wanted(piece))
    logged = before = time.monotonic()
    if not uses_other_processes() and threads == 1:
        results: Results = ((number, work(pieces[number])) for number in numbers)
    elif not uses_other_processes():
        results = _in_threads(lambda number: (number, work(pieces[number])), numbers, threads)
    else:
        blob = cloudpickle.dumps((work, os.getcwd(), torch.get_num_threads()))
        results = (_on_ray if _chosen.engine == "ray" else _in_processes)(blob, pieces, numbers)
    with closing(results):  # what has begun is cancelled
        for count, (number, result) in enumerate(results, 1):
            if isinstance(result, Exception):
                raise result
            now = time.monotonic()
            backlog[costs[number]] -= 1
            spent[costs[number]].append(now - before)
            before, to_come = now, _time_left(backlog, spent)
            whole = to_come + sum(map(sum, spent.values()))
            if what and count < len(pieces) and now - logged > max(SAY_S, whole / LINES):
                logged = now
                log.info("%d of %d %s, about %.0f s left", count, len(pieces), what, to_come)
            yield number, result


def run_all(
    work: Callable[[_Piece], _Result], pieces: Sequence[_Piece], what: str = "", **how: Any
) -> list[_Result]:
    """Return what `work` makes of pieces in their order, whichever ends first; see `run_each`."""
    results = dict(run_each(work, pieces, what, **how))
    return [results[number] for number in range(len(pieces))]


def _time_left(left: Mapping[float, int], spent: Mapping[float, Sequence[float]]) -> float:
    """Seconds that pieces `left` by cost take, as those of the same cost took,
    else in proportion to it.
    """
    # Costs are guesses: some take a hundredth of theirs, others several times theirs.
    rate = sum(map(sum, spent.values())) / max(
        sum(cost * len(times) for cost, times in spent.items()), 1e-9
    )
    mean = {cost: sum(times) / len(times) for cost, times in spent.items()}
    return sum(count * mean.get(cost, rate * cost) for cost, count in left.items())


@lru_cache(maxsize=1)
def _read(where: Any) -> Callable[[Any], Any]:
    """Work out of a file or Ray's store, once for all pieces."""
    stored = Path(where).read_bytes() if isinstance(where, str) else _ray().get(where)
    work, folder, threads = cloudpickle.loads(stored)
    os.chdir(folder)  # paths of settings may be relative
    torch.set_num_threads(threads)  # another number rounds otherwise
    threadpool_limits(1, "blas")
    return work


def _piece(where: list[Any], number: int, piece: Any) -> tuple[int, Any]:
    try:
        return number, _read(*where)(piece)
    except Exception as error:
        # as it is, not in an error of the engine: the command says it in one line
        return number, error


def _in_threads(
    call: Callable[[int], tuple[int, Any]], numbers: Iterator[int], threads: int
) -> Results:
    # Its end waits for pieces that have begun:
    # a thread inside compiled code aborts a process that exits.
    with ThreadPoolExecutor(threads) as pool:
        begun = {pool.submit(call, number) for number in islice(numbers, threads)}
        while begun:
            done, begun = wait(begun, return_when=FIRST_COMPLETED)
            begun |= {pool.submit(call, number) for number in islice(numbers, len(done))}
            for future in done:
                yield future.result()


def _jobs(calls: Iterable[Any], workers: int) -> Results:
    jobs = joblib.Parallel(
        workers,
        "loky",
        return_as="generator_unordered",
        pre_dispatch=workers,
        batch_size=1,
        max_nbytes=None,
    )
    warnings.filterwarnings("ignore", ".*tasks which were still being", UserWarning)  # at an error
    yield from jobs(joblib.delayed(call)(*arguments) for call, *arguments in calls)


def _in_processes(blob: bytes, pieces: Sequence[Any], numbers: Iterator[int]) -> Results:
    workers = _chosen.workers or max(joblib.cpu_count() // torch.get_num_threads(), 1)
    failures, begun = Counter[int](), dict[int, None]()

    def calls(where: str) -> Iterator[tuple[Any, ...]]:
        for number in chain(numbers, list(begun)):
            begun[number] = None
            yield _piece, [where], number, pieces[number]

    with NamedTemporaryFile() as file:
        file.write(blob)
        file.flush()
        while True:
            try:
                for number, result in _jobs(calls(file.name), workers):
                    del begun[number]
                    yield number, result
                return
            except BrokenProcessPool as error:
                failures.update(list(begun))
                if max(failures.values(), default=TRIES) >= TRIES:
                    raise
                log.warning(
                    "a process died, its work starts again (%s)",
                    explain_error(error).split(". ")[0],
                )


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise SettingError("engine='ray': Ray is not here; pip install 'gsparc[ray]'") from None
    return ray


def _on_ray(blob: bytes, pieces: Sequence[Any], numbers: Iterator[int]) -> Results:
    ray, threads = _ray(), torch.get_num_threads()
    if not ray.is_initialized():
        # "local": else ray.init joins any cluster that happens to run on this machine
        where = _chosen.address or os.environ.get("RAY_ADDRESS", "local")
        ray.init(where, include_dashboard=False, logging_level="error", log_to_driver=False)
    call = ray.remote(num_cpus=threads, max_retries=TRIES)(_piece)
    stored = ray.put(blob)
    running: list[Any] = []
    try:
        while True:
            most = _chosen.workers or max(int(ray.cluster_resources().get("CPU", 1)) // threads, 1)
            running += [
                call.remote([stored], n, pieces[n]) for n in islice(numbers, most - len(running))
            ]
            if not running:
                return
            (first, *_), running = ray.wait(running)
            yield ray.get(first)
    finally:
        for task in running:
            ray.cancel(task, force=True)
