"""What went wrong as one line, or None where it is a fault of this program."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from dlkf.base.errors import InputError, did_you_mean

AGAIN = "then give the same command again"
OF_THE_DISK = {
    errno.ENOSPC: f"the disk is full; make room, {AGAIN}",
    errno.EDQUOT: f"the quota of the disk is used up; make room, {AGAIN}",
    errno.EFBIG: f"the file would be larger than is allowed here; raise the limit (ulimit -f), {AGAIN}",
    errno.EROFS: "the disk is read-only; run from a folder that can be written to",
    errno.EACCES: "permission denied; run from a folder that can be written to, or change its permissions",
    errno.EPERM: "permission denied; run from a folder that can be written to, or change its permissions",
    errno.ENAMETOOLONG: "the name is too long for this disk; give a shorter one",
    errno.ELOOP: "its links point nowhere but to each other; give another path",
}
# what an exception says: what it means
SAID = {
    r"database is locked": f"the MLflow store is locked by another program; wait or close it, {AGAIN}",
    r"readonly database|unable to open database file": "the MLflow store cannot be written; run from a folder that "
    "can be written to, or give tracking.uri=sqlite:///<path>.db",
    r"database or disk is full": f"the disk is full: the MLflow store cannot grow; make room, {AGAIN}",
    r"file is not a database|disk image is malformed": "the MLflow store is damaged or no SQLite file; move mlflow.db "
    "away or give tracking.uri=sqlite:///<path>.db",
    r"out-of-date database schema|Can't locate revision": "the MLflow store belongs to another version of MLflow; "
    "run mlflow db upgrade on it or give tracking.uri=sqlite:///<path>.db",
    r"CUDA out of memory|MPS backend out of memory": "the memory of the GPU is full; give a smaller data.batch_size",
    r"No supported gpu backend|CUDAAccelerator. can not run|MPSAccelerator. can not run": "there is no GPU that "
    "PyTorch can use; give trainer.accelerator=cpu",
    r"not positive-definite|input matrix is singular": "the filter diverged: its covariance is none any more; see "
    "whether dlkf doctor finds faulty samples or fixes, and whether imu= fits the IMU",
    r"can't allocate memory|Unable to allocate|not enough memory": "the memory of this machine is full; give fewer or "
    "shorter drives, or a smaller model",
    r"Symlink loop from": "the links of a path point nowhere but to each other; give another one",
    r"invalid accelerator name|[Yy]ou selected an invalid": "trainer.accelerator is unknown; known: auto, cpu, gpu",
}
LISTED = ("aids", "datasets", "drives", "export", "model", "models", "runs")  # keys that take a list of words
ONE_FILTER = ("export", "navigate", "tune")  # commands that take one model
UNKNOWN_KEY = (
    r"is not in struct[\s\S]*full_key: (\S+)", r"Could not override '([^']+)'",
    r"full_key: (\S+)[\s\S]*is not in struct", r"Key '([^']+)' is not in struct",
)  # fmt: skip


def describe_fault(error: BaseException, command: str = "") -> str | None:
    """One line: what a user or the machine did wrong, where, and how to mend it."""
    chain = list(_chain(error))
    for link in chain:
        if isinstance(link, InputError):
            return one_line(link)
    for link in chain:
        if isinstance(link, OSError) and link.errno in OF_THE_DISK:
            where = f"{link.filename}: " if link.filename else ""
            return f"{where}{OF_THE_DISK[link.errno]}"
    if any(isinstance(link, MemoryError) for link in chain):
        return "the memory of this machine is full; give fewer or shorter drives, or look for a file that is no log"
    for link in chain:
        for pattern, meaning in SAID.items():
            if re.search(pattern, str(link)):
                return meaning
    for link in chain:
        if isinstance(link, (HydraException, OmegaConfBaseException)):
            return one_line(link, command)
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An exception and what it came from, the outermost first."""
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        yield link
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)


def one_line(error: BaseException, command: str = "") -> str:
    """A message as one line; Hydra's and OmegaConf's lists and hints are folded into it."""
    text = str(error)
    if several := re.search(r"Ambiguous value for argument '([^=']+)=([^']+)'", text):
        key, values = several.groups()
        if key.rpartition(".")[2] not in LISTED or (key == "model" and command in ONE_FILTER):
            quoted = f"'{key}=\"{values}\"' if that is one"
            return f"{key}={values}: takes one value; -m {key}={values} for a run each, {quoted}"
        return f"{key}={values}: several values are '{key}=[{values}]' as a list, or -m {key}={values} for a run each"
    if missing := re.search(r"Could not find '([^']+)'", text):
        options = re.search(r"Available options in '([^']+)':\n((?:\t.*\n?)+)", text)
        names = [name for name in options[2].split() if not name.startswith("_")] if options else []
        near = did_you_mean(missing[1].rpartition("/")[2], names)
        hint = f"{near or ';'} available in {options[1]}: {', '.join(names)}" if options else ""
        hint += "" if near else "; --config-dir adds a folder of your own"
        return f"unknown preset or config {missing[1]!r}{hint}"
    if missing := re.search(r"Could not load '([^']+)'", text):
        return f"unknown preset or config {missing[1]!r}; --help names those that there are"
    for pattern in UNKNOWN_KEY:
        if unknown := re.search(pattern, text):
            return f"unknown config key {unknown[1]!r}; --cfg job prints all keys"
    if missing := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{missing[1]} is missing; give {missing[1]}=…"
    if bare := re.search(r"Error parsing override '([^'=]*)'", text):
        return f"cannot read {bare[1]!r}; settings are key=value, such as dataset=data/town; --help names them"
    if malformed := re.search(r"(?:LexerNoViableAltException|mismatched input|extraneous input)[\s\S]*", text):
        said = malformed[0].partition("See https")[0]
        words = " ".join(said.replace("LexerNoViableAltException:", "").replace("^", "").split())
        return f"cannot read {words!r}; quote a value with such signs: 'key=\"value\"'"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    hints = ("full_key:", "object_type=", "reference_type=", "See https")
    lines = [line for line in lines if not line.startswith(hints)]
    return "; ".join(lines) or type(error).__name__
