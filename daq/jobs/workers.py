"""Workers of a fleet: threads of this process, processes of this machine, or the workers of a scheduler."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from daq.errors import ConfigurationMissing, UsageError

HERE = "127.0.0.1"
TRIMMING = "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_"
"""By which dask lets its workers give memory back after every use: a fit would spend a fifth of its time on that."""
CONNECT_S = 10  #: How long a scheduler may take to answer [s]


@dataclass(frozen=True, slots=True)
class WorkerPool:
    """Running workers."""

    executor: Executor  #: runs functions
    workers: int  #: tasks that it does at the same time; no more are ever given to it
    present: Callable[[], bool]  #: whether any worker is left


@dataclass(frozen=True, slots=True)
class Threads:
    """Threads of this process: nothing to install. Much of a fit is Python, of which one thread runs at a time."""

    workers: int

    @contextmanager
    def start_pool(self) -> Iterator[WorkerPool]:
        """Until the block ends; what runs then is waited for, what waits is given up."""
        executor = ThreadPoolExecutor(self.workers, thread_name_prefix="fleet")
        try:
            yield WorkerPool(executor, self.workers, lambda: True)
        finally:
            executor.shutdown(cancel_futures=True)


@dataclass(frozen=True, slots=True)
class Processes:
    """Processes of this machine, by dask.distributed: one cell in each."""

    workers: int

    @contextmanager
    def start_pool(self) -> Iterator[WorkerPool]:
        """Until the block ends.

        Raises:
            ConfigurationMissing: dask.distributed is not installed.
        """
        distributed, dask = dask_distributed(), import_module("dask")
        # On this machine alone: who reaches a scheduler can run anything on its workers. Its dashboard is left out;
        # its HTTP server cannot be, and takes a free port: on the usual one it would warn of any other cluster.
        with (
            dask.config.set({TRIMMING: None}),
            distributed.LocalCluster(
                n_workers=self.workers,
                threads_per_worker=1,
                processes=True,
                host=HERE,
                dashboard_address=None,
                scheduler_kwargs={"dashboard": False, "dashboard_address": f"{HERE}:0"},
            ) as cluster,
            _client(distributed, cluster.scheduler_address, self.workers) as pool,
        ):
            yield pool


@dataclass(frozen=True, slots=True)
class Scheduler:
    """The workers of a dask scheduler that runs already, here or on other machines."""

    address: str  #: tcp://HOST:PORT
    workers: int | None  #: None for as many tasks as it has threads

    @contextmanager
    def start_pool(self) -> Iterator[WorkerPool]:
        """Until the block ends; the scheduler and its workers go on.

        Raises:
            ConfigurationMissing: dask.distributed is not installed.
            UsageError: no scheduler answers at the address, or it has no workers.
        """
        with _client(dask_distributed(), self.address, self.workers) as pool:
            yield pool


def worker_pool(scheduler: str, workers: int | None) -> Threads | Processes | Scheduler:
    """Choose the workers for --scheduler and --workers.

    Args:
        scheduler: threads, processes, or an address.
        workers: None for as many as there are processors.

    Raises:
        UsageError: it is none of these.
    """
    here = workers or len(os.sched_getaffinity(0))
    if scheduler == "threads":
        return Threads(here)
    if scheduler == "processes":
        return Processes(here)
    if "://" not in scheduler:
        raise UsageError(
            "--scheduler",
            found=repr(scheduler),
            expected="threads, processes, or the address of a dask scheduler",
            remedy="for instance --scheduler processes, or --scheduler tcp://127.0.0.1:8786",
        )
    return Scheduler(scheduler, workers)


def dask_distributed() -> Any:
    """The package: an optional extra, a second to import, and without types where it is used here.

    Raises:
        ConfigurationMissing: it is not installed; with the extra to install.
    """
    try:
        return import_module("distributed")
    except ImportError as error:
        raise ConfigurationMissing(
            "--scheduler",
            found="no package dask.distributed",
            expected="that of the optional extra `fleet`",
            remedy="pip install 'drivegain[fleet]', or leave --scheduler out for threads",
        ) from error


@contextmanager
def _client(distributed: Any, address: str, workers: int | None) -> Iterator[WorkerPool]:
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--scheduler {address}",
            found=str(error) or type(error).__name__,
            expected="a dask scheduler that answers",
            remedy="start `dask scheduler`, and `dask worker ADDRESS` on each machine; or use --scheduler processes",
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(
                f"--scheduler {address}",
                found="no workers",
                expected="one or more",
                remedy=f"start some: `dask worker {address} --nthreads 1`",
            )
        executor = client.get_executor(pure=False)
        try:
            yield WorkerPool(executor, workers or threads, lambda: bool(client.nthreads()))
        finally:
            executor.shutdown(wait=False)
