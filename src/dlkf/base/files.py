"""Whole files or none: write beside the target, then move into place.

A kill leaves the old one or the new one. A folder cannot take another's place in one step: killed between the two, the
next command that writes there, or reads it, puts the old one back (:func:`restore_folder`).

A place is a path of this machine, or a URL of a store that fsspec supports (``s3://bucket/town``, ``gs://…``,
``memory://…``). There a file appears whole with its upload. A store cannot rename a folder: what replaces one takes its
files away first and brings the new ones, those on top (``drives.parquet``) last, so that what was killed half-way
in between is no dataset.
"""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from dlkf.base.errors import InputError, first_line
from dlkf.base.processes import is_gone, process_label

PARTIAL = ".partial-"  # before the process: a folder in which files wait for the rest
OLD = ".old-"  # likewise: what a new folder takes the place of, until it has


def is_url(place: object) -> bool:
    """Whether a place is in a store, and not a path of this machine."""
    return "://" in str(place)


def resolve_place(given: str | Path) -> Path:
    """A path as it is; of a URL what has a path's methods (universal_pathlib). InputError for an unknown store."""
    if not is_url(given):
        return Path(given)
    if not isinstance(given, str):
        return given
    from upath import UPath

    try:
        place = UPath(given)
        _ = place.fs  # imports the library of the store
    except (ImportError, ValueError) as error:
        known = "paths, s3:// and gs:// (pip install 'dlkf[cloud]'), memory://"
        raise InputError(f"{given}: {first_line(error)}; known are {known}") from None
    return cast(Path, place)


def folder_name(folder: str | Path) -> str:
    """The last part of a place, however it is written."""
    return resolve_place(folder).name if is_url(folder) else Path(folder).expanduser().resolve().name


def absolute_place(place: str | Path) -> str:
    """A place as another process finds it, wherever that stands."""
    return str(place) if is_url(place) else str(Path(place).expanduser().absolute())


def open_parquet(path: Path) -> Any:
    """What a reader of Parquet takes: a path as it is, of a store's file the bytes, in one request."""
    return io.BytesIO(path.read_bytes()) if is_url(path) else path


@contextmanager
def local_copy(folder: str | Path) -> Iterator[Path]:
    """A folder as one of this machine: itself, or for the block a copy of a store's."""
    if not is_url(folder):
        yield Path(folder)
        return
    place: Any = resolve_place(folder)
    with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
        with store_errors_as_input_error(folder):
            for file in place.fs.find(place.path):
                rest = file.strip("/").removeprefix(place.path.strip("/") + "/")
                (Path(here) / rest).parent.mkdir(parents=True, exist_ok=True)
                place.fs.get_file(file, f"{here}/{rest}")
        yield Path(here)


def require_empty(folder: str | Path, *, overwrite: bool) -> None:
    """InputError if ``folder`` holds something that a new result would lie among or take the place of, unless
    ``overwrite``; for a file always.

    What a killed command had not moved into place yet is no result. InputError, too, if it is in a store that does not
    answer, or in a bucket that is not there.
    """
    require_store(folder)
    target = resolve_place(folder).expanduser()
    if not is_url(folder):
        restore_folder(target.absolute())
    if target.is_file():
        raise InputError(f"out={folder} exists already and is a file; give a folder")
    if not overwrite and target.is_dir() and any(not p.name.startswith(PARTIAL) for p in target.iterdir()):
        raise InputError(f"out={folder} exists already and is not empty; give another out= or overwrite=true")


def require_store(folder: str | Path) -> None:
    """InputError where a place is no name at all, at a link that points nowhere, in a store that cannot be had, or in a
    bucket that is not there."""
    if folder == "":
        raise InputError("out= is empty; give a folder")
    place: Any = resolve_place(folder)
    if not is_url(folder):
        target = place.expanduser().absolute()
        for path in (target, *target.parents):
            if os.path.islink(path) and not os.path.exists(path):
                raise InputError(f"out={folder}: {path} points nowhere (to {os.readlink(path)}); give another folder")
        return
    if "memory" in place.fs.protocol:
        return
    bucket = place.path.lstrip("/").partition("/")[0]
    with store_errors_as_input_error(folder):
        try:
            place.fs.ls(bucket)
        except FileNotFoundError:
            raise InputError(f"{folder}: there is no bucket {bucket}; make it first") from None


@contextmanager
def store_errors_as_input_error(folder: str | Path) -> Iterator[None]:
    """Errors of a store in the block as an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if not is_url(folder):
            raise
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{folder}: store error: {said}; correct the URL, the credentials or the endpoint") from None


@contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """A place beside ``path`` to write to; what lies there when the block ends well becomes the file."""
    target = resolve_place(path)
    if is_url(path):
        with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
            yield Path(here) / target.name
            with store_errors_as_input_error(path):
                _put(Path(here), target.parent)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}")  # as two workers may write the same file
    try:
        yield beside
        sync_file(beside)
        os.replace(beside, target)
    finally:
        beside.unlink(missing_ok=True)


def sync_file(path: Path) -> None:
    """Bring a file from memory to the disk: renamed without that, it may be empty after a power cut."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


@contextmanager
def replace_folder(path: str | Path) -> Iterator[Path]:
    """A new folder beside ``path``; when the block ends well it takes its place, and that of all that lay there.

    InputError where another command has made or replaced ``path`` in the meantime, whose result then stays.
    """
    if is_url(path):
        with _whole_prefix(path) as beside:
            yield beside
        return
    target = Path(os.path.abspath(path))
    if Path.cwd().is_relative_to(target.resolve()):
        raise InputError(f"out={path} would replace the current folder; give one below it")
    restore_folder(target)
    before = _identity(target)
    beside, old = (target.with_name(f".{target.name}{what}{process_label()}") for what in (PARTIAL, OLD))
    with writable(path):
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
    try:
        yield beside
        for left in beside.rglob(".*"):  # of a worker that was killed while it wrote
            left.unlink()
        if before is not None and _identity(target) == before:
            target.rename(old)
        _take_place(beside, target, path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        if old.exists() and not target.exists():  # stopped between the two
            old.rename(target)
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def write_into(folder: str | Path) -> Iterator[Path]:
    """A temporary folder whose files move into ``folder`` when the block ends well, and vanish otherwise.

    Where ``folder`` is new it appears with all of them at once. Else files of the same name are replaced one by one and
    others in ``folder`` stay. Raises InputError if ``folder`` cannot be written to.
    """
    require_store(folder)
    if is_url(folder):
        with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
            yield Path(here)
            with store_errors_as_input_error(folder):
                _put(Path(here), resolve_place(folder))
        return
    target = Path(os.path.abspath(Path(folder).expanduser()))
    restore_folder(target)
    clear_dead(target, PARTIAL)
    whole = not os.path.lexists(target)
    created = [p for p in (target.parent, *target.parents) if not p.exists()]
    waiting = f"{PARTIAL}{process_label()}"
    beside = target.with_name(f".{target.name}{waiting}") if whole else target / waiting
    with writable(folder):
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
    try:
        yield beside
        if whole:
            _take_place(beside, target, folder)
            return
        for source in sorted(p for p in beside.rglob("*") if p.is_file()):
            final = target / source.relative_to(beside)
            final.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, final)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        for path in created:  # innermost first; a failed run leaves no empty folders behind
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _take_place(beside: Path, target: Path, given: str | Path) -> None:
    """In one step, unless something lies there."""
    try:
        beside.rename(target)
    except OSError:
        raise InputError(f"out={given}: another command wrote there in the meantime; give another folder") from None


@contextmanager
def writable(folder: str | Path) -> Iterator[None]:
    """What keeps a command from writing to ``out=`` in the block as a line."""
    try:
        yield
    except OSError as error:
        raise InputError(f"out={folder}: cannot write there ({error.strerror}); give another folder") from None


def restore_folder(target: Path) -> None:
    """Undo what commands of this machine left beside a folder when they were killed.

    What one had begun is removed. A folder that had been moved aside for a new one, which then did not come, is back.
    """
    clear_dead(target.parent, f".{target.name}{PARTIAL}")
    for old in _find_dead(target.parent, f".{target.name}{OLD}"):
        with suppress(OSError):  # another command is at it as well
            shutil.rmtree(old) if target.exists() else old.rename(target)


def clear_dead(parent: Path, begins: str) -> None:
    """Remove folders that begin so and whose process, of this machine, is gone."""
    for left in _find_dead(parent, begins):
        shutil.rmtree(left, ignore_errors=True)


def _find_dead(parent: Path, begins: str) -> list[Path]:
    """Folders that begin so and whose process, of this machine, is gone."""
    found = [p for p in parent.iterdir() if p.name.startswith(begins)] if parent.is_dir() else []
    return [p for p in found if is_gone(p.name[len(begins) :])]


def _identity(folder: Path) -> tuple[int, int] | None:
    """Device and inode of a folder; None where there is none, or an empty one."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return None
    return folder.stat().st_dev, folder.stat().st_ino


@contextmanager
def _whole_prefix(path: str | Path) -> Iterator[Path]:
    """:func:`replace_folder` in a store."""
    require_store(path)
    target: Any = resolve_place(path)
    if "/" not in target.path.strip("/") and "memory" not in target.fs.protocol:
        raise InputError(f"out={path} is a whole bucket, which it would replace; give a folder in it")
    beside = target.with_name(f".{target.name}{PARTIAL}{uuid.uuid4().hex[:12]}")
    fs = target.fs
    try:
        yield beside
        with store_errors_as_input_error(path):
            if target.exists():
                old = sorted(fs.find(target.path), key=lambda file: _depth_below(file, target.path))
                if old:
                    fs.rm(old[0])
                    fs.rm(target.path, recursive=True)
            _copy_files(fs, fs.find(beside.path), beside.path, target.path)
    finally:
        if beside.exists():
            fs.rm(beside.path, recursive=True)


def _depth_below(file: str, folder: str) -> int:
    """How many folders a file lies below one."""
    return file.strip("/").count("/") - folder.strip("/").count("/")


def _copy_files(fs: Any, files: list[str], source: str, target: str) -> None:
    """Copies in the store; files on top come last."""
    source = source.rstrip("/")
    for top in (False, True):
        some = [file for file in files if (_depth_below(file, source) == 1) == top]
        if some:
            fs.copy(some, [target.rstrip("/") + "/" + f.strip("/").removeprefix(source.strip("/") + "/") for f in some])


def _put(here: Path, target: Path) -> None:
    """The files of a folder of this machine into a store, each whole; files on top last."""
    place: Any = target
    files = [p for p in sorted(here.rglob("*")) if p.is_file()]
    for top in (False, True):
        some = [p for p in files if (p.parent == here) == top]
        if some:
            keys = [(place / p.relative_to(here).as_posix()).path for p in some]
            place.fs.put([str(p) for p in some], keys)
