"""The core under AddressSanitizer and UndefinedBehaviorSanitizer: faults, inputs of any kind, memory put away."""

from __future__ import annotations

import ctypes
import subprocess

import numpy as np
import pytest

from dlkf.onboard.c_source import EXAMPLES
from dlkf.onboard.library import find_compiler
from tests.onboard.conftest import ARM
from tests.onboard.core import Core
from tests.onboard.faults import FAULTS
from tests.onboard.programs import HERE, SANITIZED, compile_program, lines, run, tool
from tests.onboard.streams import apart, calls, through_core

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
EVERY_SAMPLE = ("none", "a gap of 0.2 s", "damage of all kinds")  # the state at every sample takes its time
USUAL = (*EVERY_SAMPLE, "single samples", "single fixes", "single samples of sensors", "clocks set back 50 s",
         "coarse positions alone, 3 s late", "sensors 15 s late")  # fmt: skip
FUZZ_S = 600  # of each of the two


@pytest.fixture(scope="module", params=["core", pytest.param("core and filter", marks=pytest.mark.exports)])
def sanitized(request, exported, tmp_path_factory):
    """``navigate`` with both sanitizers, in the core alone or in the filter's long loops too."""
    folder = tmp_path_factory.mktemp("sanitized")
    made = exported[3].path if request.param == "core" else None
    main = EXAMPLES / "navigate.c"
    return compile_program(str(find_compiler()), exported[0], main, folder / "navigate", SANITIZED, filter_of=made)


@pytest.mark.parametrize("names", [USUAL, pytest.param(FAULTS, marks=pytest.mark.exports)], ids=["usual", "all"])
def test_faults_as_lines(names, sanitized, tables):
    """One after the other through one program each; the exit code of a report would be another."""
    sent = calls(tables)
    for name in names:
        given = {"input": lines(FAULTS[name][0](sent)), "capture_output": True, "text": True}
        every = ["--samples"] if name in EVERY_SAMPLE else []
        done = subprocess.run([sanitized, *every, "--arm", *map(str, ARM)], **given)
        assert done.returncode == 0, f"{name}: {done.stderr[-2000:]}"
        assert len(done.stdout.splitlines()) > (100 if every else 15), name


def test_lines_with_flipped_bytes(sanitized, tables):
    log = bytearray(lines(calls(tables)).encode())
    g = np.random.default_rng(0)
    for place in g.integers(len(log), size=4000):
        log[place] = g.integers(256)
    done = subprocess.run([sanitized], input=bytes(log), capture_output=True)
    assert done.returncode in (0, 2), done.stderr[-2000:]


def test_restored_at_every_call_it_gives_the_same(exported, tables):
    """After every call, from the first on, the memory goes on in another core, and the one left is erased; fixes come
    late, and some are refused."""
    sent = FAULTS["fixes 20 km off, some of them late"][0](calls(tables, lambda t: t + 1.3))
    whole = through_core(Core(exported[3].path, ARM), sent, look=1)
    core, other = Core(exported[3].path, ARM), Core(exported[3].path)
    saved, size, words = bytes(core.memory), len(core.memory), []
    rows: list[tuple[int, np.ndarray]] = []
    for k, call in enumerate(sent):
        ctypes.memmove(other.memory, saved, size)
        ctypes.memset(core.memory, 0xA5, size)
        assert other.fits and not core.fits
        core, other = other, core
        answers = through_core(core, [call])
        words += answers.words
        rows += [(k, row) for _, row in answers.rows]
        saved = bytes(core.memory)
    assert apart(whole.rows, rows) == 0 and words == whole.words and len(rows) > 60
    core.memory[0] = bytes([core.memory.raw[0] ^ 1])
    assert not core.fits


@pytest.mark.exports
@pytest.mark.parametrize("harness", ["fuzz_calls.c", "fuzz_lines.c"])
def test_a_fuzzer_finds_nothing(harness, exported, tables, tmp_path):
    """libFuzzer with both sanitizers; lines begin from a log that aligns."""
    flags = (*SANITIZED, "-fsanitize=fuzzer", f"-I{EXAMPLES}")
    program = compile_program(
        tool("clang"), exported[0], HERE / harness, tmp_path / "fuzz", flags, filter_of=exported[3].path
    )  # the filter's loops have no branches to cover
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    if harness == "fuzz_lines.c":
        short = [c for c in calls(tables) if c.arguments[0] < 12]
        (corpus / "log").write_text(lines(short))
    run([program, "-timeout=20", f"-max_total_time={FUZZ_S}", "-max_len=200000", "-close_fd_mask=3", corpus],
        cwd=tmp_path)  # fmt: skip
