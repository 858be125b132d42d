"""What the compiler's command line may set, and what it may not."""

from __future__ import annotations

import subprocess

import pytest

from dlkf.onboard.c_source import EXAMPLES
from dlkf.onboard.library import CORE, FILTER, find_compiler
from dlkf.running.solution import COLUMNS
from tests.onboard.conftest import ARM
from tests.onboard.core import Core
from tests.onboard.programs import STRICT, compile_program, lines
from tests.onboard.streams import calls, through_core

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")


@pytest.fixture(scope="module")
def log(tables):
    """Half a minute in lines."""
    return [c for c in calls(tables) if c.arguments[0] < 30]


def ran(exported, sent, out, *switches: str) -> subprocess.CompletedProcess:
    """``navigate`` with a core that was compiled with these."""
    flags = ("-O0", *STRICT, *switches)
    program = compile_program(
        str(find_compiler()), exported[0], EXAMPLES / "navigate.c", out / "navigate", flags, filter_of=exported[3].path
    )
    command = [program, "--arm", *map(str, ARM)]
    return subprocess.run(command, input=lines(sent), capture_output=True, text=True)


@pytest.mark.parametrize("switches", [("-DDLKF_LATE_S=2", "-DDLKF_IMU_HZ=100"), ("-DDLKF_LATE_S=60",)], ids=" ".join)
def test_less_memory_or_more_gives_the_same(switches, exported, log, tmp_path):
    done = ran(exported, log, tmp_path, *switches)
    want = through_core(Core(exported[3].path, ARM), log).solution
    rows = [[float(x) for x in line.split(",")] for line in done.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == pytest.approx(want[:, 0].tolist()) and done.returncode == 0
    lat, last = COLUMNS.index("lat_deg"), want[-1]
    assert rows[-1][2:5] == pytest.approx(last[lat : lat + 3], rel=1e-11)


def test_without_the_search_the_course_is_the_heading(exported, log, tmp_path):
    done = ran(exported, log, tmp_path, "-DDLKF_SEARCH_S=0")
    assert done.returncode == 0 and len(done.stdout.splitlines()) > 15


def test_an_imu_faster_than_the_memory_holds_is_told(exported, log, tmp_path):
    """Of 100 Hz there must be room for a second."""
    done = ran(exported, log, tmp_path, "-DDLKF_LATE_S=2", "-DDLKF_IMU_HZ=10")
    assert done.returncode == 2 and "x refused: more samples than the memory holds" in done.stderr


WRONG_SIZES = (
    "LATE_S=-1",
    "LATE_S=1.5",
    "IMU_HZ=0",
    "IMU_HZ=99.9",
    "IMU_HZ=1",
    "AID_HZ=0",
    "SEARCH_S=-1",
    "SEARCH_S=x",
)


def test_wrong_sizes_do_not_compile(exported):
    compiler, source = str(find_compiler()), str(exported[0] / "dlkf.c")
    for size in ("LATE_S=0", "SEARCH_S=0", "IMU_HZ=9", "AID_HZ=1", *WRONG_SIZES):
        switches = ["-DDLKF_LATE_S=1"] * ("LATE_S" not in size) + [f"-DDLKF_{size}"]
        done = subprocess.run([compiler, "-std=c99", "-Wundef", "-Werror", "-fsyntax-only", *switches, source],
                              capture_output=True, text=True)  # fmt: skip
        assert (done.returncode != 0) is (size in WRONG_SIZES), (size, done.stderr)


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_arithmetic_without_nan_is_refused(flag, exported):
    """It ran for ever."""
    sources = [name for name in (*CORE, *FILTER) if name != "weights.c"]
    for name in sources:
        done = subprocess.run(
            [find_compiler(), "-std=c99", flag, "-fsyntax-only", exported[0] / name], capture_output=True, text=True
        )
        assert done.returncode and "compile without -ffast-math" in done.stderr, name


def test_the_core_promotes_no_float(exported):
    """Constants such as NAN are floats; the filter's own code, made from tensors of several types, is not meant."""
    flags = (*STRICT, "-Wdouble-promotion", f"-I{exported[0]}", "-fsyntax-only")
    sources = [*(exported[0] / name for name in CORE), EXAMPLES / "navigate.c"]
    done = subprocess.run([str(find_compiler()), *flags, *sources], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
