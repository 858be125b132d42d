"""An app's export as it leaves the phone: a .zip in the place of a drive's folder."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dlkf.base.errors import InputError

LARGEST_BYTES = 8 << 30  # unpacked: a day of a phone's sensors is a tenth
LARGEST_RATIO, SMALL_BYTES = 200, 64 << 20  # of unpacked to packed size: text of sensors packs tenfold


def is_archive(path: Path) -> bool:
    """Whether a file is a .zip (of any name but an office document's or a NumPy archive's)."""
    return path.suffix.lower() == ".zip" and path.is_file() and zipfile.is_zipfile(path)


@contextmanager
def unpack(path: Path) -> Iterator[Path]:
    """A folder as it is; of a .zip a folder with its files, gone afterwards, past folders that hold one folder alone.

    InputError for a damaged archive, and one that unpacks to more than a log can be.
    """
    if path.is_dir():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="dlkf-zip-") as name:
        folder = Path(name)
        try:
            with zipfile.ZipFile(path) as archive:
                size = sum(info.file_size for info in archive.infolist())
                if size > LARGEST_BYTES or size > max(SMALL_BYTES, LARGEST_RATIO * path.stat().st_size):
                    raise InputError(f"{path}: unpacks to {size / 2**30:.1f} GiB, which no log of its size does")
                archive.extractall(folder)  # never above the folder, never more than the headers state
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError) as error:
            raise InputError(f"{path}: cannot be unpacked ({error}); unpack it yourself and give the folder") from None
        while len(inside := [p for p in folder.iterdir() if p.name != "__MACOSX"]) == 1 and inside[0].is_dir():
            folder = inside[0]
        try:
            yield folder
        except InputError as error:
            error.args = (str(error).replace(str(folder), str(path)),)  # where its user finds the files
            raise


def drive_places(source: Path) -> list[Path]:
    """What may each be a drive in a folder: its subfolders and archives."""
    return sorted(p for p in source.iterdir() if not p.name.startswith(".") and (p.is_dir() or is_archive(p)))


def drive_name(path: Path) -> str:
    """Of a folder its name, of a .zip that without its ending, of any other file what stands before the first point; of
    a ROS 2 bag's metadata.yaml the name of the bag's folder."""
    path = (path.parent if path.name == "metadata.yaml" else path).absolute()
    if path.is_dir():
        return path.name
    return path.stem if path.suffix.lower() == ".zip" else path.name.partition(".")[0]
