"""Whole files or none: write beside the target, then move into place. A kill leaves the old one or the new one."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dlkf.errors import InputError


def vacant(folder: str | Path, *, overwrite: bool) -> None:
    """InputError if ``folder`` holds something that a new result would lie among, unless ``overwrite``."""
    target = Path(folder).expanduser()
    if not overwrite and target.is_dir() and any(target.iterdir()):
        raise InputError(f"out={folder} exists already and is not empty; give another out= or overwrite=true")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A place beside ``path`` to write to; what lies there when the block ends well becomes the file."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        yield beside
        os.replace(beside, target)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """A new folder beside ``path``; when the block ends well it takes its place, and that of all that lay there."""
    target = Path(path).absolute()
    beside, old = (target.with_name(f".{target.name}.{what}-{os.getpid()}") for what in ("partial", "old"))
    try:
        beside.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"out={path}: cannot write there ({error.strerror}); give another folder") from None
    try:
        yield beside
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
    target = Path(folder)
    created = [p for p in (target, *target.parents) if not p.exists()]
    try:
        target.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=".partial-", dir=target))
    except OSError as error:
        raise InputError(
            f"out={folder}: cannot write there ({error.strerror}); give another folder"
        ) from None
    try:
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
