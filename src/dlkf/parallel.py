"""The same work on many drives, on joblib's engines: processes of this machine, workers of Dask, Ray or Spark.

What is done to an item is done whole or not at all (:mod:`dlkf.files`) and depends on the item alone, so an engine
may do it again where a worker was lost, and what comes out is the same wherever it ran.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from dlkf.errors import InputError

DASK = "dask://"
PATIENCE_S = 30  # for a cluster to answer, and for its first worker
REGISTERED_BY = {  # engines that make themselves known to joblib: module, function, package
    "ray": ("ray.util.joblib", "register_ray", "ray"),
    "spark": ("joblibspark", "register_spark", "joblibspark pyspark"),
}

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(
    function: Callable[[Item], Result], items: Iterable[Item], where: int | str | None = None, *, threads: int = 1
) -> Iterator[Result]:
    """``function(item)`` of every item, in their order, each as soon as it and those before it are done.

    ``where``: ``None`` in this process, in ``threads`` threads; a whole number, so many processes of this machine;
    ``dask://host:port``, the workers of that scheduler; ``ray`` and ``spark``, those of the cluster that Ray and Spark
    find by their own settings, or as many of this machine as it has cores (results and errors come when the last is
    done); any other word, the backend of that name that a program has registered with joblib. Functions and results
    travel pickled, so a function is one of a module (with ``functools.partial`` round it) and dlkf is installed where
    it runs. An item is a plain value (number, text, tuple): joblib would place any other on one worker of Dask, where
    it is lost with the worker.

    The first error ends it. InputError for an engine that is not there, and where workers keep dying.
    """
    if where is None:
        yield from _in_threads(function, items, threads)
        return
    with _engine(where) as run:
        yield from run((function, (item,), {}) for item in items)


def check(where: Any, *places: object) -> None:
    """InputError for what names no engine, and for places that its workers do not see."""
    if where is not None and any(str(place).startswith("memory:") for place in places):
        raise InputError(f"parallel={where}: other processes do not see what is in memory://; leave parallel out")
    if where is None or (isinstance(where, int) and not isinstance(where, bool) and where >= 1):
        return
    if not isinstance(where, str) or where in ("", DASK):
        raise InputError(
            f"parallel={where}: must be a number of processes, {DASK}host:port of a scheduler, ray or spark"
        )
    if not where.startswith(DASK):
        import joblib  # a tenth of a second that other commands do not wait for

        _register(where)
        if where not in joblib.parallel.BACKENDS:
            known = f"a whole number, {DASK}host:port, ray, spark, or register one with joblib"
            raise InputError(f"parallel={where}: no backend of joblib has that name; give {known}")


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        try:  # an interrupt never waits for items that have not begun
            yield from pool.map(function, items)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _engine(where: int | str) -> Iterator[Any]:
    """What takes calls as joblib's ``delayed`` makes them (function, arguments, keywords) and yields results."""
    import joblib
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    check(where)
    options: dict[str, Any] = {"return_as": "generator", "batch_size": 1, "max_nbytes": None}
    try:
        if isinstance(where, int):
            yield joblib.Parallel(n_jobs=where, backend="loky", **options)
        elif where.startswith(DASK):
            with _client(where) as backend:
                yield joblib.Parallel(n_jobs=-1, backend=backend, **options)
        else:
            with _heard(where), joblib.parallel_config(where):
                backend: Any = joblib.parallel.get_active_backend()[0]
            if backend.supports_return_generator:
                yield joblib.Parallel(n_jobs=-1, backend=backend, **options)
            else:
                whole = joblib.Parallel(n_jobs=-1, backend=backend, **{**options, "return_as": "list"})
                yield lambda calls: _all(whole, calls, where)
    except TerminatedWorkerError:
        raise InputError(
            f"parallel={where}: a process was killed, most likely for want of memory; give fewer"
        ) from None


def _all(run: Any, calls: Iterable[tuple], where: str) -> Iterator[Any]:
    """What calls give on an engine that gives all of it at last, and may lose an error on the way (Spark's does)."""
    with _heard(where):
        outcomes = run((_outcome, call, {}) for call in calls)
    for result, error in outcomes:
        if error is not None:
            raise error
        yield result


@contextmanager
def _heard(where: str) -> Iterator[None]:
    """An engine's own trouble as a line."""
    try:
        yield
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        hint = "is there such a cluster, and do its workers run this Python with dlkf?"
        raise InputError(f"parallel={where}: the engine failed ({said}); {hint}") from None


def _outcome(function: Callable, arguments: tuple, keywords: dict[str, Any]) -> tuple[Any, Exception | None]:
    """A result, or an error in its place."""
    try:
        return function(*arguments, **keywords), None
    except Exception as error:
        return None, error


def _register(where: str) -> None:
    """Have an engine that can make itself known to joblib do so; InputError where it is not installed."""
    if where not in REGISTERED_BY:
        return
    module, function, package = REGISTERED_BY[where]
    try:
        getattr(importlib.import_module(module), function)()
    except ImportError as error:
        raise InputError(f"parallel={where}: {error}; pip install {package}") from None


@contextmanager
def _client(where: str) -> Iterator[Any]:
    """joblib's backend for a Dask scheduler, which hands the work of a lost worker to the others."""
    try:
        from distributed import Client, KilledWorker
        from joblib._dask import DaskDistributedBackend
    except ImportError:
        raise InputError(f"parallel={where} needs Dask: pip install 'dlkf[dask]'") from None
    address = "tcp://" + where.removeprefix(DASK)
    try:
        client = Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"parallel={where}: no scheduler answers ({said}); start one: dask scheduler") from None
    with client:
        try:
            yield DaskDistributedBackend(client=client, wait_for_workers_timeout=PATIENCE_S)
        except TimeoutError:
            mend = f"start one: dask worker {address}"
            raise InputError(f"parallel={where}: the scheduler has no workers; {mend}") from None
        except KilledWorker as error:
            raise InputError(f"parallel={where}: every worker that took this work was lost: {error}") from None
