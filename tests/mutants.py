"""Whether the tests would notice: small faults put into the core one by one, each with the tests that must fail.

    python -m tests.mutants                 all of mutants.yaml (make mutants)
    python -m tests.mutants strapdown loss  those in whose file or old text one of the words stands

The tree is copied once; a fault is written into the copy, its tests run there up to the first that fails, and the file
is put back; at the end the tests that noticed must pass without a fault. Libraries are loaded once and every run is a
fork, so that a fault costs little more than its tests.
"""

from __future__ import annotations

import compileall
import importlib
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".yaml")
COPIED = ("src", "tests", "conf", "docs", "pipelines", "pyproject.toml", "README.md", "RESULTS.md", "Makefile")
LOADED = (
    "pytest",
    "torch",
    "lightning.pytorch",
    "pandas",
    "pyarrow.parquet",
    "numba",
    "hydra",
    "scipy.stats",
    "scipy.linalg",
    "scipy.spatial.transform",
    "pyins.strapdown",
    "pyproj",
)
CAUGHT, SURVIVED = 1, 0  # what pytest ends with: tests failed, all passed


class Mutant(NamedTuple):
    """A fault: in ``file`` (below src/dlkf) ``old`` becomes ``new``, and one of ``tests`` must fail."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.old, self.new))
        return f"{self.file}: {old} → {new}"


def read_mutants() -> list[Mutant]:
    """All of mutants.yaml, in its order."""
    return [
        Mutant(file, old, new, tuple(f"tests/{t}" for t in tests.split()))
        for file, tests_of in yaml.safe_load(LIST.read_text()).items()
        for tests, changes in tests_of.items()
        for old, new in changes
    ]


def copy_tree(to: Path) -> None:
    """What the tests need, with compiled code and times of change, so that nothing is compiled again."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, to / name)
        else:
            shutil.copy2(ROOT / name, to / name)


def load_libraries() -> None:
    """What the package and the tests import: these themselves every fork reads from the copy."""
    for name in LOADED:
        importlib.import_module(name)
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    assert not any(name.partition(".")[0] == "dlkf" for name in sys.modules)


def run_tests(tree: Path, mutant: Mutant | None, tests: tuple[str, ...], output: Path) -> int:
    """Exit code of pytest over some tests in the copy, in a process of its own."""
    process = multiprocessing.get_context("fork").Process(target=_run, args=(tree, mutant, tests, output))
    process.start()
    process.join()
    return process.exitcode if process.exitcode is not None else -1


def _run(tree: Path, mutant: Mutant | None, tests: tuple[str, ...], output: Path) -> None:
    with output.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": f"{tree / 'src'}{os.pathsep}{tree}", "OMP_NUM_THREADS": "1"}
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # no check of shapes either, which costs seconds to load
    sys.dont_write_bytecode = False
    if mutant is not None and "compiled" in mutant.file:  # loops of one file are kept compiled into those of another
        os.environ["NUMBA_CACHE_DIR"] = str(tree / "loops" / str(time.time_ns()))
    ours = {str(ROOT), str(ROOT / "src")}
    sys.path[:] = [str(tree / "src"), str(tree), *(place for place in sys.path if place not in ours)]
    import pytest

    options = ["-x", "--tb=line", "-p", "no:cacheprovider", f"--basetemp={tree / 'tmp'}"]
    options += ["-o", "addopts=-q --strict-markers"]
    os._exit(int(pytest.main([*options, *tests])))


def main() -> None:
    """Print each fault with what became of it; exit code 1 if one survived or could not be tried."""
    words = sys.argv[1:]
    chosen = [m for m in read_mutants() if not words or any(w in f"{m.file} {m.old}" for w in words)]
    load_libraries()
    lost: list[str] = []
    noticed: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Path(folder)
        copy_tree(tree)
        compileall.compile_dir(tree / "src", quiet=2)
        for k, mutant in enumerate(chosen):
            file = tree / "src" / "dlkf" / mutant.file
            text, changed = file.read_text(), file.stat()
            if text.count(mutant.old) != 1:
                lost.append(f"{mutant}: old text stands {text.count(mutant.old)} times")
                continue
            began = time.monotonic()
            file.write_text(text.replace(mutant.old, mutant.new))
            os.utime(file, (changed.st_mtime + 10 + k, changed.st_mtime + 10 + k))  # no compiled code of another fault
            code = run_tests(tree, mutant, mutant.tests, tree / "output.txt")
            file.write_text(text)
            os.utime(file, (changed.st_atime, changed.st_mtime))
            said = (tree / "output.txt").read_text().splitlines()
            by = next((x.removeprefix("FAILED ").partition(" - ")[0] for x in said if x.startswith("FAILED ")), "")
            verdict = {CAUGHT: "caught", SURVIVED: "SURVIVED"}.get(code, f"not tried (pytest ended with {code})")
            print(f"{k + 1:3}/{len(chosen)} {verdict:8} {time.monotonic() - began:5.0f} s  {mutant}  {by}", flush=True)
            noticed |= {by} - {""}
            if code != CAUGHT:
                lost.append(str(mutant))
                if code != SURVIVED:
                    print("\n".join(said[-15:]), flush=True)
        if noticed and run_tests(tree, None, tuple(sorted(noticed)), tree / "output.txt"):
            sys.exit((tree / "output.txt").read_text() + "\nThis test fails without a fault.")
    print(f"{len(chosen) - len(lost)} of {len(chosen)} caught")
    if lost:
        sys.exit("\n".join(("not caught:", *lost)))


if __name__ == "__main__":
    main()
