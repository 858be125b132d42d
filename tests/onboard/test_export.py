"""An exported filter against the one it was made of: in C++, in a stream, in a batch."""

from __future__ import annotations

import json
import pickle
import re
import shutil
import subprocess
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation

from dlkf.data.alignment import ALIGN
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_checked
from dlkf.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.onboard import compiled_filter
from dlkf.onboard.c_source import CPP, exporting, write_source
from dlkf.onboard.check import boundary_fixes, difference, vehicle_run, write_log
from dlkf.onboard.compiled_filter import CompiledFilter
from dlkf.onboard.functions import FIX, ROW, Begin, Grid, Turn, carried_by
from dlkf.onboard.library import LIBRARY, Library, build, compiler
from dlkf.onboard.meanings import of_column
from dlkf.running.batched import run_filter
from dlkf.running.estimate import estimates_table
from dlkf.running.reanchoring import FrameChange, reanchored
from dlkf.running.replay import played
from dlkf.running.solution import COLUMNS
from dlkf.running.start import aligned_drives
from dlkf.running.streaming import StreamingFilter
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from tests.shell import PATIENCE_S

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler here")
IMU = ImuSpec(
    "mems", SensorErrors(2.5e-3, 0.02, 1e-3, 3600.0, 3e-3, 3e-3), SensorErrors(9e-5, 1e-3, 1e-4, 3600.0, 3e-3, 3e-3)
)
ARM = (1.0, 0.3, -1.2)
GRID = Grid(50, 0.02)
ROUNDING = 1e-6  # m, m/s, rad; sums in another order, and what a minute makes of that


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """A minute; the car drives off after some seconds."""
    folder = tmp_path_factory.mktemp("town")
    config = DatasetConfig("town", hours=1 / 60, drive_minutes=1.0, gnss=GnssConfig(lever_arm_b=ARM))
    dataset = simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)
    return read_checked(dataset, drive_rows(dataset)[0], reference=False)


@pytest.fixture(scope="module")
def drive(tables):
    """On the grid."""
    return drive_from_tables(tables, "", 50.0, 1.0, torch.float64)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A gated filter as C, compiled: folder, filter, layout, library."""
    folder = tmp_path_factory.mktemp("exported")
    estimator = build_filter("mbkf15_gated", IMU)
    layout = write_source(folder, estimator, GRID, "mbkf15_gated", {})
    return folder, estimator, layout, Library(build(folder), layout.size)


@pytest.fixture
def compiled(exported):
    """The same in the place of an estimator."""
    _, estimator, layout, library = exported
    return CompiledFilter(estimator, GRID, layout, library)


def test_the_exported_filter_is_the_original(exported, tables, drive):
    _, estimator, layout, library = exported
    found = difference(estimator, library, tables, drive, Begin(estimator, GRID, layout).epochs)
    assert found.epochs > 40
    assert max(*found.largest.values(), found.std) < ROUNDING


def test_the_example_in_cpp_writes_the_same_solution(exported, tables, drive, tmp_path):
    folder, estimator, layout, library = exported
    cxx = shutil.which("c++") or shutil.which("g++")
    if cxx is None:
        pytest.skip("no C++ compiler here")
    write_log(tmp_path / "drive.csv", tables, drive)
    assert len((CPP / "navigate.cpp").read_text().splitlines()) < 150
    files = CPP / "navigate.cpp", folder / LIBRARY, "-o", tmp_path / "go"
    subprocess.run([cxx, "-O2", "-Wall", "-Werror", f"-I{folder}", *files], check=True)
    arm = [str(x) for x in ARM]

    def run(log: str) -> np.ndarray:
        done = subprocess.run(
            [tmp_path / "go", "--arm", *arm], input=log, capture_output=True, text=True, check=True,
            env={"LD_LIBRARY_PATH": str(folder)},
        )  # fmt: skip
        rows = np.array([[float(x) for x in line.split(",")] for line in done.stdout.splitlines()])
        return rows[np.sort(len(rows) - 1 - np.unique(rows[::-1, 0], return_index=True)[1])]  # the last word on a time

    lines = (tmp_path / "drive.csv").read_text().splitlines()
    rows = run("\n".join(lines))
    first, mine = vehicle_run(library, drive, boundary_fixes(tables, drive), Begin(estimator, GRID, layout).epochs)
    np.testing.assert_allclose(rows[:, 0], drive.t0 + first + 1 + np.arange(len(mine)), atol=1e-6)
    same = [ROW.index(c) for c in COLUMNS[1:]]
    np.testing.assert_allclose(rows[:, 1 : len(COLUMNS)], mine[:, same], rtol=1e-9, atol=1e-9)
    for given, log, said in (
        (["--arm", "1", "0.3"], lines[:0], "navigate: --arm: take [--arm x y z, in metres] [--latency]"),
        (["--arm", "1", "0,3", "-1"], lines[:0], "navigate: --arm: take [--arm"),
        (["--latncy"], lines[:0], "navigate: --latncy: take"),
        ([], lines[:3] + lines[3:400:2], "missing, or come at another rate than DLKF_RATE_HZ at t = "),
        ([], ["t,x", *lines[:60], ""], "navigate: no sample and no fix, passed over like all such: t,x\n"),
        ([], lines[:60], "navigate: nothing solved: the car must move under GNSS"),
    ):
        command = [tmp_path / "go", *given]
        done = subprocess.run(
            command, input="\n".join(log) + "\n", capture_output=True, text=True, env={"LD_LIBRARY_PATH": str(folder)}
        )
        assert done.returncode == 2 and said in done.stderr and not done.stdout, done.stderr
    # fixes that come late give the same in the end
    for late_s, since in ((2.7, -1.0), (9.7, 5.0)):  # the second: all on which it aligns, ten epochs back

        def comes(line: str, late_s: float = late_s, since: float = since) -> float:
            t = float(line.split(",")[1])
            return t + (late_s if line.startswith("gnss") and t > since else 0.0)

        late = sorted(lines, key=comes)
        np.testing.assert_allclose(run("\n".join(late)), rows, rtol=1e-9, atol=1e-9)


def test_nothing_is_allocated(exported):
    folder = exported[0]
    command = ["nm", "-D", "--undefined-only", folder / LIBRARY]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    needed = {line.split()[-1].partition("@")[0] for line in listed.stdout.splitlines()}
    assert "sqrt" in needed or "sin" in needed  # it is the right list
    assert not needed & {"malloc", "calloc", "realloc", "free", "_Znwm", "posix_memalign", "aligned_alloc"}


def test_the_description_tells_every_number_of_the_memory(exported):
    folder, _, layout, _ = exported
    described = json.loads((folder / "step.json").read_text())
    assert sum(int(np.prod(f["shape"])) for f in described["memory"]["fields"]) == layout.size
    assert [column["name"] for column in described["row"]] == list(ROW)
    assert described["fix"][3] == {"name": "vel_n", "place": 3, "meaning": "velocity North [m/s]"}
    header = (folder / "step.h").read_text()
    assert f"#define DLKF_MEMORY {layout.size}\n" in header and "@" not in header
    assert re.search(r"DLKF_LAT_DEG, DLKF_LON_DEG", header)


@pytest.mark.parametrize("kind", ["aekf_car_gated", "mbkf33_nhc_gated_gm", "dlkf", "plus"])
def test_every_number_has_a_meaning(kind):
    made = {"dlkf": learned, "plus": talkative_plus}
    layout = carried_by(made[kind]() if kind in made else build_filter(kind, IMU), GRID)
    assert [f.name for f in layout.fields if not f.plain().get("meaning")] == []


def test_columns_say_axis_and_unit():
    said = {c: of_column(c) for c in (*FIX, *ROW)}
    assert said["std_gyro_error_z"] == "1σ of gyroscope error down, measured less true [rad/s]"
    assert said["innovation_std_pos_d"] == "1σ of fix less expected: position Down [m]"
    assert all(text.endswith("]") for c, text in said.items() if c not in ("quality", "gnss_used"))


def test_a_batch_through_the_compiled_filter(compiled, drive):
    torch.manual_seed(0)
    batch = aligned_drives([drive], ALIGN).select(torch.zeros(3, dtype=torch.int64))
    batch = replace(batch, available=torch.rand(batch.available.shape) < 0.7)
    want, got = (run_filter(batch, f) for f in (compiled.estimator, compiled))
    for name in ("imu_error", "innovation", "std"):
        torch.testing.assert_close(getattr(got, name), getattr(want, name), atol=ROUNDING, rtol=ROUNDING)
    for mine, theirs in zip((*got.prior, *got.posterior), (*want.prior, *want.posterior)):
        torch.testing.assert_close(mine, theirs, atol=ROUNDING, rtol=0)
    assert torch.equal(got.used, want.used)
    assert run_filter(batch.in_precision(torch.float32), compiled).std.dtype == torch.float32


def test_a_stream_through_the_compiled_filter_and_another_frame(compiled, tables, drive):
    def solution(estimator) -> pd.DataFrame:
        stream = StreamingFilter(estimator, lever_arm_b=ARM, phase_s=drive.t0, anchor_m=100.0)
        return estimates_table([e for receipt in played(stream, tables.imu, tables.gnss) for e in receipt.estimates])

    want, got = solution(compiled.estimator), solution(compiled)
    assert len(want) > 40
    np.testing.assert_allclose(got.to_numpy(float), want.to_numpy(float), rtol=1e-6, atol=ROUNDING)


def test_it_is_made_once_and_can_be_put_away(exported, tmp_path, monkeypatch):
    folder, estimator, _, _ = exported
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = tmp_path / "dlkf" / "compiled" / compiled_filter._digest(estimator, GRID)
    shutil.copytree(folder, kept)  # made before
    made = compiled_filter.compiled_filter(estimator, 50.0, 1.0)
    again = pickle.loads(pickle.dumps(made))
    assert again.grid == made.grid and again.layout.size == made.layout.size
    assert compiled_filter._digest(build_filter("mbkf15", IMU), GRID) != kept.name


def test_one_library_serves_every_preset_and_every_factor():
    """What a filter is told in numbers is in its memory; a number of it in the code would make another filter."""
    other = ImuSpec(
        "b", SensorErrors(1e-3, 0.03, 2e-3, 600.0, 1e-3, 4e-3), SensorErrors(3e-5, 2e-3, 3e-4, 300.0, 0.0, 1e-3)
    )
    changed = Tuning(**{f.name: (0.9 if 0.9 <= f.default < 1 else 1.7) * f.default for f in fields(Tuning)})
    recorded = []
    for imu, tuning in ((IMU, Tuning()), (other, changed)):
        estimator = build_filter("aekf_car_gated", imu, tuning=tuning)  # everything that has factors
        with exporting():
            turn = Turn(estimator, GRID, carried_by(estimator, GRID))
            program = torch.export.export(turn.eval(), turn.example(), strict=False)
        numbers = {name: x.tolist() for name, x in (program.state_dict | program.constants).items()}
        code = program.graph_module.code, numbers  # what C is written from
        recorded.append((code, estimator.code, compiled_filter._digest(estimator, GRID)))
    assert recorded[0] == recorded[1]


def test_noise_goes_with_the_drive_into_another_frame(drive):
    loud, quiet = (build_filter("mbkf15", IMU, tuning=Tuning(accel_noise=x)) for x in (9.0, 1.0))
    batch = aligned_drives([drive], ALIGN)
    memory, other = loud.begin(batch)[0], quiet.begin(batch)[0]
    moved = reanchored(memory, FrameChange(batch.frame, batch.frame), other)
    assert torch.equal(moved.windows.spread, memory.windows.spread)
    assert not torch.equal(moved.windows.spread, other.windows.spread)


def test_what_does_not_fit_is_told(compiled, drive, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="compiled for 50 samples"):
        compiled.begin(aligned_drives([drive_with(drive, 25)], ALIGN))
    with pytest.raises(InputError, match="smoothed"):
        compiled_filter.compiled_filter(build_filter("mbkf15_rts", IMU), 50.0, 1.0)
    monkeypatch.setattr("dlkf.onboard.library.compiler", lambda: None)
    with pytest.raises(InputError, match="no C compiler"):
        build(tmp_path)


def drive_with(drive, samples: int):
    """Every second sample of a drive."""
    return replace(drive, imu=drive.imu[:, ::2][:, :samples], rate_hz=25.0)


def learned(**settings) -> LearnedFilter:
    torch.manual_seed(0)
    network = {"cnn_channels": 4, "lstm_hidden": 8, "lstm_layers": 2, "dense": [16, 8]}
    return LearnedFilter(LearnedConfig.from_mapping({"network": network, **settings})).eval()


def talkative_plus() -> PlusFilter:
    """A network that says something."""
    torch.manual_seed(0)
    model = PlusFilter(PlusConfig(parts=("process", "fix", "across", "offset", "speed", "residual"))).eval()
    torch.nn.init.normal_(model.network.noise.weight, std=0.05)
    return model


def test_many_drives_through_a_large_network_go_through_torch(drive, monkeypatch):
    model = learned()
    layout = carried_by(model, GRID)
    monkeypatch.setattr(compiled_filter, "LARGE", sum(p.numel() for p in model.parameters()) - 1)
    in_c = CompiledFilter(model, GRID, layout, None)  # would be called for fewer
    batch = aligned_drives([drive], ALIGN)
    with pytest.raises(AttributeError, match="run"):
        run_filter(batch, in_c)
    many = batch.select(torch.zeros(compiled_filter.MANY, dtype=torch.int64))
    want, got = (run_filter(many, f) for f in (model, in_c))
    assert torch.equal(got.posterior.p_n, want.posterior.p_n)


def test_ten_hours_allocate_nothing(exported, tmp_path):
    """36,000 epochs in C, counted by an allocator of the program's own; the filter still knows where it is."""
    folder, *_ = exported
    files = Path(__file__).with_name("ten_hours.c"), folder / LIBRARY, "-o", tmp_path / "go", "-lm"
    subprocess.run([compiler(), "-O2", f"-I{folder}", *files], check=True)
    told = {"capture_output": True, "text": True, "check": True}
    said = subprocess.run([tmp_path / "go"], env={"LD_LIBRARY_PATH": str(folder)}, timeout=PATIENCE_S, **told).stdout
    epochs, allocations, more_kB, off = (float(x) for x in re.findall(r"[\d.]+(?= )", said))
    assert epochs > 36_000 and allocations == 0
    assert more_kB <= 64  # pages of the stack that are touched late
    assert off < 2.0  # fixes of 1 m, and circles by a clock that knows no Earth rate


INCLUDED = (
    "geometry_msgs/msg/twist_with_covariance_stamped.hpp", "nav_msgs/msg/odometry.hpp", "rclcpp/rclcpp.hpp",
    "sensor_msgs/msg/imu.hpp", "sensor_msgs/msg/nav_sat_fix.hpp",
)  # fmt: skip


def test_the_ros_2_node_says_what_the_example_does(exported, tables, drive, tmp_path):
    """With what it takes of ROS 2 in ros2.hpp, never built with ROS 2 itself. Late fixes change nothing."""
    folder, *_ = exported
    cxx = shutil.which("c++") or shutil.which("g++")
    if cxx is None:
        pytest.skip("no C++ compiler here")
    for name in INCLUDED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('#include "ros2.hpp"\n')
    here = Path(__file__).parent
    for made, source in (("node", here / "ros2_log.cpp"), ("example", CPP / "navigate.cpp")):
        flags = ["-std=c++17", "-O2", "-Wall", "-Werror", *(f"-I{x}" for x in (folder, tmp_path, here, CPP))]
        subprocess.run([cxx, *flags, source, folder / LIBRARY, "-o", tmp_path / made], check=True)
    write_log(tmp_path / "drive.csv", tables, drive)
    lines = [x.split(",") for x in (tmp_path / "drive.csv").read_text().splitlines()]
    lines = [x if x[0] == "imu" else [*x[:11], "nan", "nan", "nan", "1"] for x in lines]  # what a node is not told

    def run(program: str, *arguments: str, late: float = 0.0) -> np.ndarray:
        order = sorted(lines, key=lambda x: float(x[1]) + (late if x[0] == "gnss" else 0.0))
        told = "".join(f"{','.join(x)}\n" for x in order)
        given = {"input": told, "capture_output": True, "text": True, "check": True}
        said = subprocess.run(
            [tmp_path / program, *arguments, *map(str, ARM)], env={"LD_LIBRARY_PATH": str(folder)}, **given
        ).stdout
        return np.array([[float(x) for x in line.split(",")] for line in said.splitlines()])

    want, got = run("example", "--arm"), run("node")
    np.testing.assert_allclose(got[:, 0], want[-len(got) :, 0], atol=1e-6)
    want = want[-len(got) :]
    assert len(got) > 40
    np.testing.assert_allclose(got[:, [2, 1, 3, 9, 8]], want[:, 1:6], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(-got[:, 10], want[:, 6], rtol=1e-9, atol=1e-9)
    turned = Rotation.from_euler("ZYX", want[:, [9, 8, 7]]).as_matrix()  # body FRD to NED
    ned, frd = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    np.testing.assert_allclose(Rotation.from_quat(got[:, [5, 6, 7, 4]]).as_matrix(), ned @ turned @ frd, atol=1e-9)
    late = run("node", late=0.3)[-1]  # s, after the end of their epochs: all but the last one count in the last row
    lines.remove(max((x for x in lines if x[0] == "gnss"), key=lambda x: float(x[1])))
    np.testing.assert_allclose(late, run("node")[-1], rtol=1e-12)


@pytest.mark.exports
@pytest.mark.parametrize(
    "estimator",
    [
        *(lambda n=n: build_filter(n, IMU) for n in ("ins", "aekf", "mbkf21_car", "mbkf33_nhc_gated_gm")),
        learned,
        lambda: learned(outage_mode="run", frame="heading", imu_error="affine", imu_error_bound=4.0),
        talkative_plus,
    ],
    ids=["ins", "aekf", "mbkf21_car", "mbkf33_nhc_gated_gm", "dlkf_literal", "dlkf", "plus"],
)
def test_every_kind_of_filter(estimator, tables, drive, tmp_path):
    model = estimator()
    layout = write_source(tmp_path, model, GRID, "tested", {})
    found = difference(model, Library(build(tmp_path), layout.size), tables, drive, Begin(model, GRID, layout).epochs)
    single = isinstance(model, torch.nn.Module)  # a network's float32
    assert max(found.largest.values()) < (1e-3 if single else ROUNDING)
