"""Where a training run keeps what it needs to go on after a kill: a folder named by its configuration."""

from __future__ import annotations

import errno
import fcntl
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dlkf.base.errors import InputError
from dlkf.base.files import replace_file
from dlkf.base.own_code import digest_modules, find_own_modules
from dlkf.data.store import dataset_digest
from dlkf.training.callbacks.checkpoints import LAST

STATE = "state.json"
LOCK = "lock"


def run_folder(
    name: str, digest: str, *, resume: bool, root: Path = Path("outputs/train")
) -> tuple[Path, dict[str, Any]]:
    """Folder and state of the unfinished run of a configuration's ``digest``, or a new one with an empty state.

    InputError where a file that the run would go on from is damaged.
    """
    base = root / name / digest
    attempt = 1
    while True:
        folder = base.with_name(base.name if attempt == 1 else f"{base.name}-{attempt}")
        if not folder.exists():
            return folder, {}
        if resume and not (state := read_state(folder)).get("finished"):
            if (last := folder / LAST).is_file():
                with _damaged_as_input_error(last), zipfile.ZipFile(last) as parts:  # as torch writes it
                    if parts.testzip():
                        raise zipfile.BadZipFile
            return folder, state
        attempt += 1


def read_state(folder: Path) -> dict[str, Any]:
    """The state file, empty where there is none. InputError for a damaged one."""
    path = folder / STATE
    if not path.is_file():
        return {}
    with _damaged_as_input_error(path):
        return dict(json.loads(path.read_text()))


def finished_before(folder: Path, datasets: Sequence[str], config: Mapping[str, Any]) -> str | None:
    """MLflow run of the training before a new ``folder``, if that finished on the same data with the same own code."""
    digest, _, attempt = folder.name.partition("-")
    before = folder.with_name(f"{digest}-{int(attempt) - 1}" if attempt not in ("", "2") else digest)
    if folder.exists() or not (state := read_state(before)).get("finished"):
        return None
    try:
        check_digests(datasets, config, state)
    except InputError:
        return None
    return str(state["run_id"])


@contextmanager
def _damaged_as_input_error(path: Path) -> Iterator[None]:
    """Whatever reading a file raises in the block but an OSError."""
    try:
        yield
    except OSError:
        raise
    except Exception:
        raise InputError(f"{path} is damaged; remove {path.parent} or give resume=false") from None


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """The folder is this process's alone during the block. InputError where another one of this training has it."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # which ends with the process, however that ends
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):  # else a disk without locks
                raise InputError(
                    f"the same training is running in {folder}; wait for its end, or give resume=false for another one"
                ) from None
        yield


def check_digests(
    datasets: Sequence[str], config: Mapping[str, Any], state: Mapping[str, Any]
) -> dict[str, dict[str, str]]:
    """Digests of every dataset (``data``) and of every module of a user's that the configuration names (``code``).

    InputError where an unfinished run began with others.
    """
    data, code = {str(d): dataset_digest(d) for d in datasets}, digest_modules(find_own_modules(config))
    for kind, digests in (("data", data), ("code", code)):
        for name, before in state.get(kind, {}).items():
            if digests.get(name) != before:
                raise InputError(
                    f"{name} is not what the unfinished run began with (digest {digests.get(name)}, was {before}): "
                    f"bring the old {kind} back, or start afresh with resume=false"
                )
    return {"data": data, "code": code}


def write_state(folder: Path, **values: Any) -> None:
    """Merge values into the state file, whole or not at all."""
    with replace_file(folder / STATE) as beside:
        beside.write_text(json.dumps(read_state(folder) | values, indent=1))
