"""Whole files or none: write into a hidden folder beside the target, then move all into place."""

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
