"""Where tasks are done: processes of this machine (joblib), or a cluster (Dask distributed).

Both do the same: each task is done once or, where its worker dies, again, and its outcome is
handed over as it comes.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress

from workbench import interrupts
from workbench.errors import DataError, one_line
from workbench.extras import required
from workbench.sweep.plan import Job, Task
from workbench.sweep.worker import Outcome, work

MOST_RETRIES = 3
"""How often in a row workers may die without one task done in between."""
_IDLE_SECONDS = 10
"""After which a worker without work ends: those of a sweep that was killed must not stay."""


def cores() -> int:
    """Cores that this process may use."""
    import joblib

    return int(joblib.cpu_count())


def outcomes(
    job: Job, tasks: Sequence[Task], workers: int, scheduler: str | None
) -> Iterator[Outcome]:
    """Every task's outcome, in the order in which they are done.

    Raises :class:`DataError` where workers die again and again or a cluster is not reached.
    """
    if not tasks:
        return
    if scheduler is not None:
        yield from _on_cluster(job, tasks, scheduler)
    elif workers == 1:
        for task in tasks:
            interrupts.check()
            yield work(job, task)
    else:
        yield from _on_machine(job, tasks, workers)


def _on_machine(job: Job, tasks: Sequence[Task], workers: int) -> Iterator[Outcome]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        # Workers are told of their tasks through semaphores, which some systems do not have.
        multiprocessing.Semaphore(0)
    except (ImportError, OSError) as error:
        raise DataError(
            f"--workers {workers}: this system has no shared memory for processes (/dev/shm): "
            f"{one_line(error)}; --workers 1 needs none"
        ) from error
    waiting = {task.number: task for task in tasks}
    deaths = 0
    try:
        while waiting:
            with parallel_config(
                backend="loky", inner_max_num_threads=1, idle_worker_timeout=_IDLE_SECONDS
            ):
                run = Parallel(
                    n_jobs=min(workers, len(waiting)),
                    return_as="generator_unordered",
                    batch_size=1,
                    pre_dispatch="2*n_jobs",
                )(delayed(work)(job, task) for task in list(waiting.values()))
                try:
                    for outcome in run:
                        interrupts.check()
                        del waiting[outcome.task]
                        deaths = 0
                        yield outcome
                except TerminatedWorkerError as error:
                    deaths += 1
                    if deaths > MOST_RETRIES:
                        raise DataError(
                            f"workers died {deaths} times in a row (out of memory?); what was done "
                            "is kept, and fewer --workers need less memory"
                        ) from error
    except BaseException:
        # Whatever ends the sweep ends the tasks under way: nobody waits for them any more.
        with suppress(Exception):
            get_reusable_executor().shutdown(wait=True, kill_workers=True)
        raise


def _on_cluster(job: Job, tasks: Sequence[Task], scheduler: str) -> Iterator[Outcome]:
    distributed = required("distributed", "--scheduler", "cluster")
    try:
        client = distributed.Client(scheduler, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise DataError(f"--scheduler {scheduler}: cannot be reached: {one_line(error)}") from error
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise DataError(f"--scheduler {scheduler}: the cluster has no workers")
        futures = [
            client.submit(work, job, task, pure=False, retries=MOST_RETRIES) for task in tasks
        ]
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                interrupts.check()
                try:
                    outcome = future.result()
                except distributed.KilledWorker as error:
                    raise DataError(
                        f"--scheduler {scheduler}: workers died on one task again and again; "
                        "what was done is kept"
                    ) from error
                future.release()
                yield outcome
        except BaseException:
            client.cancel(futures)
            raise


def default_workers(scheduler: str | None) -> int:
    """How many workers a sweep plans for where none are asked for."""
    if scheduler is not None:
        return 2 * (os.cpu_count() or 1)
    return cores()
