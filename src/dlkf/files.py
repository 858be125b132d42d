"""Whole files or none: write beside the target, then move into place. A kill leaves the old one or the new one.

A place is a path of this machine, or a URL of a store that fsspec knows (``s3://bucket/town``, ``gs://…``,
``memory://…``). There a file appears whole with its upload. A store cannot rename a folder: what replaces one takes its
files away first and brings the new ones, those on top (``drives.parquet``) last, so that what was killed half-way
in between is no dataset.
"""

from __future__ import annotations

import glob
import io
import os
import platform
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from dlkf.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there, and nothing cleared
    fcntl = None

PARTIAL = ".partial-"  # how a folder begins in which files wait for the rest
OURS = f"{PARTIAL}{platform.node()}-"  # of this machine, whose locks are seen from here on every file system


def is_url(place: object) -> bool:
    """Whether a place is in a store, and not a path of this machine."""
    return "://" in str(place)


def placed(given: str | Path) -> Path:
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
        raise InputError(f"{given}: {str(error).splitlines()[0]}; known are {known}") from None
    return cast(Path, place)


def name_of(folder: str | Path) -> str:
    """The last part of a place, however it is written."""
    return placed(folder).name if is_url(folder) else Path(folder).expanduser().resolve().name


def absolute(place: str | Path) -> str:
    """A place as another process finds it, wherever that stands."""
    return str(place) if is_url(place) else str(Path(place).expanduser().absolute())


def readable(path: Path) -> Any:
    """What a reader of Parquet takes: a path as it is, of a store's file the bytes, in one request."""
    return io.BytesIO(path.read_bytes()) if is_url(path) else path


@contextmanager
def at_hand(folder: str | Path) -> Iterator[Path]:
    """A folder as one of this machine: itself, or for the block a copy of a store's."""
    if not is_url(folder):
        yield Path(folder)
        return
    place: Any = placed(folder)
    with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
        with told(folder):
            for file in place.fs.find(place.path):
                rest = file.strip("/").removeprefix(place.path.strip("/") + "/")
                place.fs.get_file(file, str(_made(Path(here) / rest)))
        yield Path(here)


def vacant(folder: str | Path, *, overwrite: bool) -> None:
    """InputError if ``folder`` holds something that a new result would lie among, unless ``overwrite``.

    What a killed command had not moved into place yet is no result; the next one clears it away. InputError, too, if
    it is in a store that does not answer, or in a bucket that is not there.
    """
    reached(folder)
    target = placed(folder).expanduser()
    if not overwrite and target.is_dir() and any(not p.name.startswith(PARTIAL) for p in target.iterdir()):
        raise InputError(f"out={folder} exists already and is not empty; give another out= or overwrite=true")


def reached(folder: str | Path) -> None:
    """InputError where a place is no name at all, in a store that cannot be had, or in a bucket that is not there."""
    if folder == "":
        raise InputError("out= is empty; give a folder")
    place: Any = placed(folder)
    if not is_url(folder) or "memory" in place.fs.protocol:
        return
    bucket = place.path.lstrip("/").partition("/")[0]
    with told(folder):
        try:
            place.fs.ls(bucket)
        except FileNotFoundError:
            raise InputError(f"{folder}: there is no bucket {bucket}; make it first") from None


@contextmanager
def told(folder: str | Path) -> Iterator[None]:
    """What a store says in the block as an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if not is_url(folder):
            raise
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{folder}: the store says: {said}; mend the URL, the credentials or the endpoint") from None


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A place beside ``path`` to write to; what lies there when the block ends well becomes the file."""
    target = placed(path)
    if is_url(path):
        with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
            yield Path(here) / target.name
            with told(path):
                _put(Path(here), target.parent)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}")  # as two workers may write the same file
    try:
        yield beside
        os.replace(beside, target)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """A new folder beside ``path``; when the block ends well it takes its place, and that of all that lay there."""
    if is_url(path):
        with _whole_prefix(path) as beside:
            yield beside
        return
    target = Path(path).absolute()
    if Path.cwd().is_relative_to(target.resolve()):
        raise InputError(f"out={path} would take the place of the folder you stand in; give one below it")
    beside, old = (target.with_name(f".{target.name}{what}{os.getpid()}") for what in (OURS, ".old-"))
    _cleared(target.parent, f".{target.name}{OURS}")
    try:
        beside.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"out={path}: cannot write there ({error.strerror}); give another folder") from None
    try:
        with _alive(beside):
            yield beside
            for left in beside.rglob(".*"):  # of a worker that was killed while it wrote
                left.unlink()
            if target.exists():
                target.rename(old)
            beside.rename(target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def staged(folder: str | Path) -> Iterator[Path]:
    """A temporary folder whose files move into ``folder`` when the block ends well, and vanish otherwise.

    Files of the same name are replaced, others in ``folder`` stay. Raises InputError if ``folder`` cannot be
    written to.
    """
    reached(folder)
    if is_url(folder):
        with tempfile.TemporaryDirectory(prefix="dlkf-") as here:
            yield Path(here)
            with told(folder):
                _put(Path(here), placed(folder))
        return
    target = Path(folder)
    _cleared(target, OURS)
    created = [p for p in (target, *target.parents) if not p.exists()]
    try:
        target.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=OURS, dir=target))
    except OSError as error:
        raise InputError(f"out={folder}: cannot write there ({error.strerror}); give another folder") from None
    try:
        with _alive(beside):
            yield beside
            for source in sorted(p for p in beside.rglob("*") if p.is_file()):
                final = target / source.relative_to(beside)
                final.parent.mkdir(parents=True, exist_ok=True)
                os.replace(source, final)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        for path in created:  # innermost first; a failed run leaves no empty folders behind
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


@contextmanager
def _whole_prefix(path: str | Path) -> Iterator[Path]:
    """:func:`whole_folder` in a store."""
    reached(path)
    target: Any = placed(path)
    if "/" not in target.path.strip("/") and "memory" not in target.fs.protocol:
        raise InputError(f"out={path} is a whole bucket, whose place it would take; give a folder in it")
    beside = target.with_name(f".{target.name}{PARTIAL}{uuid.uuid4().hex[:12]}")
    fs = target.fs
    try:
        yield beside
        with told(path):
            if target.exists():
                old = sorted(fs.find(target.path), key=lambda file: _deep(file, target.path))
                if old:
                    fs.rm(old[0])
                    fs.rm(target.path, recursive=True)
            _moved(fs, fs.find(beside.path), beside.path, target.path)
    finally:
        if beside.exists():
            fs.rm(beside.path, recursive=True)


@contextmanager
def _alive(folder: Path) -> Iterator[None]:
    """Holds the kernel's lock of a folder for the block, which ends with the process however that ends."""
    if fcntl is None:
        yield
        return
    at = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks: then nobody takes it for dead either
            fcntl.flock(at, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(at)


def _cleared(parent: Path, begins: str) -> None:
    """Removes folders of this machine that begin so and whose process was killed: nobody holds their lock.

    Those of the last second stay, as they may be about to be locked.
    """
    if fcntl is None:
        return
    for left in parent.glob(f"{glob.escape(begins)}*"):
        with suppress(OSError):
            at = os.open(left, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(at, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if time.time() - os.fstat(at).st_mtime > 1:
                    shutil.rmtree(left)
            finally:
                os.close(at)


def _made(file: Path) -> Path:
    """A file whose folder is there."""
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _deep(file: str, folder: str) -> int:
    """How many folders a file lies below one."""
    return file.strip("/").count("/") - folder.strip("/").count("/")


def _moved(fs: Any, files: list[str], source: str, target: str) -> None:
    """Copies in the store; files on top come last."""
    source = source.rstrip("/")
    for top in (False, True):
        some = [file for file in files if (_deep(file, source) == 1) == top]
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
