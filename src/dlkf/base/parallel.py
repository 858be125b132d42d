"""The same work on many drives: in this process, in others of this machine, or on the workers of a Dask cluster.

What is done to an item is done whole or not at all (:mod:`dlkf.base.files`) and depends on the item alone, so it may be
done again where a worker was lost, and what comes out is the same wherever it ran.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from dlkf.base.errors import InputError, first_line
from dlkf.base.signals import delay_signals

DASK = "dask://"
LONGEST_DELAY_S = 0.2  # of an interrupt while threads work
AHEAD = 8  # items that wait for each thread
PATIENCE_S = 30  # for a cluster to answer, and for its first worker

Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(
    function: Callable[[Item], Result], items: Iterable[Item], where: int | str | None = None, *, threads: int = 1
) -> Iterator[Result]:
    """``function(item)`` of every item, in their order, each as soon as it and those before it are done.

    ``where``: ``None`` in this process, in ``threads`` threads; a whole number, so many processes of this machine
    (joblib's loky); ``dask://host:port``, the workers of that scheduler. Functions and results travel pickled, so a
    function is one of a module (with ``functools.partial`` round it) and dlkf is installed where it runs. An item is a
    plain value (number, text, tuple): joblib would place any other on one worker of Dask, where it is lost with the
    worker.

    The first error ends it. InputError for a scheduler that is not there, and where workers keep dying.
    """
    if where is None:
        yield from _in_threads(function, items, threads)
        return
    with _joblib(where) as run:
        yield from run((function, (item,), {}) for item in items)


def check_engine(where: Any, *places: object) -> None:
    """InputError for what names no engine, and for places that its workers do not see."""
    if where is None:
        return
    if any(str(place).startswith("memory:") for place in places):
        raise InputError(f"parallel={where}: other processes do not see what is in memory://; leave parallel out")
    count = isinstance(where, int) and not isinstance(where, bool) and where >= 1
    if not count and not (isinstance(where, str) and where.startswith(DASK) and where != DASK):
        raise InputError(f"parallel={where}: must be a number of processes or {DASK}host:port of a scheduler")


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """In threads of this process.

    A signal handler that raises between two of the locks of ``concurrent.futures`` leaves one of them locked for good,
    and the threads wait for it for ever. So signals wait while this thread is in there.
    """
    if threads == 1:
        yield from map(function, items)
        return
    pool, left, begun = ThreadPoolExecutor(threads), iter(items), deque()
    try:  # an interrupt never waits for items that have not begun
        while True:
            with delay_signals():
                begun.extend(pool.submit(function, item) for item in islice(left, AHEAD * threads - len(begun)))
                done = bool(begun) and bool(wait([begun[0]], LONGEST_DELAY_S).done)
            if not begun:
                return
            if done:
                yield begun.popleft().result()
    finally:
        with delay_signals():
            pool.shutdown(cancel_futures=True)


@contextmanager
def _joblib(where: int | str) -> Iterator[Any]:
    """What takes calls as joblib's ``delayed`` makes them (function, arguments, keywords) and yields results."""
    import joblib

    check_engine(where)
    options: dict[str, Any] = {"return_as": "generator", "batch_size": 1, "max_nbytes": None}
    try:
        if isinstance(where, int):
            yield joblib.Parallel(n_jobs=where, backend="loky", **options)
            return
        with (
            _client(where) as client,
            joblib.parallel_config("dask", n_jobs=-1, client=client, wait_for_workers_timeout=PATIENCE_S),
        ):
            yield joblib.Parallel(**options)
    except BrokenProcessPool:
        raise InputError(
            f"parallel={where}: a process was killed, most likely because memory ran out; give fewer"
        ) from None


@contextmanager
def _client(where: str) -> Iterator[Any]:
    """A client of a Dask scheduler, which hands the work of a lost worker to the others."""
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise InputError(f"parallel={where} needs Dask: pip install 'dlkf[dask]'") from None
    address = "tcp://" + where.removeprefix(DASK)
    try:
        client = Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"parallel={where}: no scheduler answers ({first_line(error)}); start one: dask scheduler"
        ) from None
    with client:
        try:
            yield client
        except TimeoutError:
            mend = f"start one: dask worker {address}"
            raise InputError(f"parallel={where}: the scheduler has no workers; {mend}") from None
        except KilledWorker as error:
            raise InputError(f"parallel={where}: every worker that took this work was lost: {error}") from None
