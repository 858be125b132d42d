"""One training on several processes of this machine, each with its part of every batch (Lightning's DDP).

Every process makes the whole batch with its outages, keeps every n-th segment, and the gradients are averaged. So that
the average of the processes' losses is the loss of the whole batch, a mean divides by :func:`count_per_process`.
"""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from dlkf.base.errors import InputError

RANK = "LOCAL_RANK"  # torch's and Lightning's word for a process's number
READY = "DLKF_READY"  # folder where a further process records that it is about to join


def is_worker() -> bool:
    """Whether this process was started to train along."""
    return int(os.environ.get(RANK, "0")) > 0


def processes() -> int:
    """How many processes train together now."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def count_per_process(count: Tensor) -> Tensor:
    """A count that is spread over the processes, summed up and divided by their number; at least one."""
    if processes() > 1:
        count = count.to(torch.float64)
        dist.all_reduce(count)
        return count.clamp_min(1) / processes()
    return count.clamp_min(1)


def gather_all(items: list) -> list:
    """The items of all processes, in the order of the processes."""
    if processes() == 1:
        return items
    lists: list[Any] = [None] * processes()
    dist.all_gather_object(lists, items)
    return [item for part in lists for item in part]


@contextmanager
def with_workers(command: Sequence[str] | None, count: int) -> Iterator[None]:
    """``count`` − 1 further processes of ``command`` while the block runs; in a further process itself only the block.

    InputError where one ends before its time: its own message stands on stderr.
    """
    if count == 1 or is_worker():
        yield
        return
    if command is None:
        raise InputError(f"trainer.devices is {count}: only the command train starts further processes; give 1")
    with tempfile.TemporaryDirectory() as ready:
        ours = {
            "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(_free_port()), "WORLD_SIZE": str(count),
            "NODE_RANK": "0", RANK: "0",
        }  # fmt: skip
        before = {key: os.environ.get(key) for key in ours}
        os.environ.update(ours)
        others = [subprocess.Popen(command, env=os.environ | {RANK: str(k), READY: ready}) for k in range(1, count)]
        try:
            while len(list(Path(ready).iterdir())) < len(others):
                _check(others)
                time.sleep(0.05)
            yield
            for other in others:
                other.wait()
            _check(others)
        except Exception:
            time.sleep(1.0)  # a broken connection is seen before the end of the process that broke it
            _check(others)
            raise
        finally:
            for other in others:
                other.kill()
                other.wait()
            if dist.is_initialized():
                dist.destroy_process_group()
            for key, value in before.items():
                os.environ.pop(key, None) if value is None else os.environ.update({key: value})


def join() -> None:
    """Signal to the first process that this further one has its data and is about to train."""
    if folder := os.environ.get(READY):
        (Path(folder) / os.environ[RANK]).touch()


def _check(others: Sequence[subprocess.Popen]) -> None:
    codes = [code for other in others if (code := other.poll())]
    if codes:
        raise InputError(f"a further process of the training ended with code {codes[0]}; its message stands above")


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]
