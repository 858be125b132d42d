"""The core on other processors, by cross-compilers and emulation: the same solution as here."""

from __future__ import annotations

import io
import re

import numpy as np
import pandas as pd
import pytest

from dlkf.data.store import drive_rows
from dlkf.data.validate import read_drive
from dlkf.onboard.c_source import EXAMPLES
from dlkf.onboard.library import CORE, FILTER, find_compiler
from dlkf.running.solution import COLUMNS
from tests.cars import REAL
from tests.onboard.conftest import ARM
from tests.onboard.core import Core
from tests.onboard.programs import HERE, STRICT, compile_program, lines, run, stack_of_calls, tool
from tests.onboard.streams import Calls, calls, through_core

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
CORTEX_M7 = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-O2")
SMALL = ("-DDLKF_IMU_HZ=100", "-DDLKF_LATE_S=2")
KINDS = {"gnss": 0, "imu": 1, "speed": -1, "heading": -2, "baro": -3}  # as board.c reads them
STACK = 8192  # bytes of any call


@pytest.mark.parametrize("cc", ["clang", "gcc"])
def test_a_compiler_has_no_warnings(cc, exported):
    command = [tool(cc), *STRICT, "-fsyntax-only", f"-I{exported[0]}"]
    run([*command, *(exported[0] / name for name in (*CORE, *FILTER)), EXAMPLES / "navigate.c"])


@pytest.mark.exports
def test_gcc_has_no_warnings_and_the_stack_of_every_call_is_small(exported, tmp_path):
    deepest = stack_of_calls(tool("gcc"), exported[0], tmp_path, ("-O2", *STRICT))
    assert {"dlkf_imu", "dlkf_gnss", "dlkf_aid", "dlkf_pose", "dlkf_open", "dlkf_finish"} < set(deepest)
    assert deepest["dlkf_imu"] > deepest["dlkf_turn"] > 500 and max(deepest.values()) < STACK


@pytest.mark.exports
@pytest.mark.parametrize("log", ["simulated", "rtkx"])
@pytest.mark.parametrize("cpu", ["aarch64-linux-gnu", "arm-linux-gnueabihf"])
def test_arm_under_emulation(cpu, log, exported, tables, tmp_path):
    """A drive with late fixes, and a real one as it was logged; other processors contract and order sums in their own
    way."""
    cc, qemu = tool(f"{cpu}-gcc"), tool("qemu-aarch64" if "64" in cpu else "qemu-arm")
    flags = ("-O2", "-static")
    program = compile_program(cc, exported[0], EXAMPLES / "navigate.c", tmp_path / "navigate", flags)
    sent, arm = calls(tables, lambda t: t + 1.3), ARM
    if log != "simulated":
        if not (REAL / log).is_dir():
            pytest.skip(f"no {log} here")
        real = read_drive(REAL / log, drive_rows(REAL / log)[0], reference=False)
        sent, arm = calls(real), real.row.lever_arm_b
    done = run([qemu, program, "--arm", *map(str, arm)], input=lines(sent))
    rows = pd.read_csv(io.StringIO(done.stdout)).drop_duplicates("t", keep="last").sort_values("t")
    want = through_core(Core(exported[3].path, arm), sent).solution
    rows = rows[rows["t"] <= want[-1, 0]]  # the example finishes the last update interval as well
    np.testing.assert_allclose(rows[list(COLUMNS)], want, rtol=1e-8, atol=1e-7)


@pytest.mark.exports
def test_a_microcontroller_under_emulation(exported, tables, tmp_path):
    """A Cortex-M7 (the board mps2-an500): it links, its sizes, and a minute's drive on it."""
    sent = [c for c in calls(tables) if c.arguments[0] < 20]
    (tmp_path / "drive.h").write_text(_as_c(sent))
    (tmp_path / "board.c").write_text((HERE / "board.c").read_text())
    flags = (*CORTEX_M7, *SMALL)
    link = ("--specs=rdimon.specs", f"-T{HERE / 'board.ld'}", "-lm")
    cc = tool("arm-none-eabi-gcc")
    program = compile_program(cc, exported[0], tmp_path / "board.c", tmp_path / "board.elf", flags, link=link)
    found = run([tool("arm-none-eabi-size"), program]).stdout.splitlines()[1].split()
    assert int(found[0]) < 1e6 and int(found[2]) < 1e6
    qemu = [tool("qemu-system-arm"), "-M", "mps2-an500", "-nographic", "-semihosting", "-kernel", program]
    rows = np.array([[float(x) for x in line.split(",")] for line in run(qemu, timeout=120).stdout.splitlines()])
    want = through_core(Core(exported[3].path, ARM), sent).solution
    columns = [COLUMNS.index(c) for c in ("t", "lat_deg", "lon_deg", "height_m", "vel_n", "yaw")]
    np.testing.assert_allclose(rows, want[:, columns], rtol=1e-8, atol=1e-7)


def _as_c(sent: Calls) -> str:
    rows = []
    for call in sent:
        flat = [x for part in call.arguments for x in (part if isinstance(part, list) else [part])]
        numbers = [float(KINDS[call.kind]), *map(float, flat)]
        rows.append("{" + ", ".join(re.sub("nan", '__builtin_nan("")', f"{x:.17g}") for x in numbers) + "}")
    arm = ", ".join(map(str, ARM))
    return f"#define ARM (const double[]){{{arm}}}\nstatic const double CALLS[][15] = {{\n" + ",\n".join(rows) + "};\n"
