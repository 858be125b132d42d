"""An exported filter against the one it was made of: in the example, in a stream, in a batch."""

from __future__ import annotations

import io
import json
import pickle
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation

from dlkf.base.errors import InputError
from dlkf.data.alignment import ALIGN
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.learned_kalman import LearnedKalmanConfig, LearnedKalmanFilter
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.onboard import compiled_filter
from dlkf.onboard.c_source import COLUMNS as CORE_COLUMNS
from dlkf.onboard.c_source import EXAMPLES, list_columns, write_source
from dlkf.onboard.check import measure_difference, write_log
from dlkf.onboard.compiled_filter import CompiledFilter
from dlkf.onboard.core_drives import run_core_drive
from dlkf.onboard.functions import Turn, make_layout
from dlkf.onboard.library import LIBRARY, Library, build, find_compiler
from dlkf.onboard.library_cache import seal
from dlkf.onboard.meanings import describe_column
from dlkf.onboard.recording import export_mode, record
from dlkf.running.batched import run_filter
from dlkf.running.reanchoring import FrameChange, reanchor
from dlkf.running.replay import UnalignedError, replay_drive, stream_drive
from dlkf.running.solution import COLUMNS, estimates_table
from dlkf.running.start import align_drives
from dlkf.running.streaming import StreamingFilter
from tests.onboard.conftest import ARM, GRID, IMU, QUICK
from tests.onboard.core import Core
from tests.onboard.streams import calls, through_core
from tests.shell import PATIENCE_S

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
ROUNDING = 1e-6  # m, m/s, rad; sums in another order, and what a minute makes of that


@pytest.fixture
def compiled(exported):
    """The same in the place of an estimator."""
    _, estimator, layout, library = exported
    return CompiledFilter(estimator, GRID, layout, library)


def test_the_exported_filter_is_the_original(exported, tables, drive):
    _, estimator, _, library = exported
    found = measure_difference(estimator, library, tables, drive)
    assert found.epochs > 40
    assert max(*found.largest.values(), found.std) < ROUNDING


@pytest.fixture(scope="session")
def example(exported, tmp_path_factory):
    """``navigate``, compiled."""
    folder, *_ = exported
    program = tmp_path_factory.mktemp("example") / "navigate"
    strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    files = EXAMPLES / "navigate.c", folder / LIBRARY, "-o", program, "-lm"
    subprocess.run([find_compiler(), *strict, f"-I{folder}", *files], check=True)
    return program


def run_example(example, exported, log: str, *arguments: str) -> tuple[pd.DataFrame, str, int]:
    """Its rows, what it said, its exit code."""
    given = {"input": log, "capture_output": True, "text": True, "env": {"LD_LIBRARY_PATH": str(exported[0])}}
    done = subprocess.run([example, *arguments], **given)
    return pd.read_csv(io.StringIO(done.stdout)), done.stderr, done.returncode


def test_the_example_writes_what_the_core_gives(exported, example, tables, tmp_path):
    write_log(tmp_path / "drive.csv", tables)
    lines = (tmp_path / "drive.csv").read_text().splitlines()
    arm = ["--arm", *map(str, ARM)]
    core = through_core(Core(exported[3].path, ARM), calls(tables))
    rows, said, code = run_example(example, exported, "\n".join(lines), *arm)
    assert code == 0 and "waiting for the car to move under GNSS" in said and "aligned" in said
    np.testing.assert_allclose(rows[list(COLUMNS)], core.solution, rtol=1e-9, atol=1e-9)
    assert not rows.revised.any() and rows.gnss_used.mean() > 0.9
    started = [x for x in lines if float(x.split(",")[1]) > 5.3]  # within a second
    assert "refused" not in run_example(example, exported, "\n".join(started), *arm)[1]
    rows, _, _ = run_example(example, exported, "\n".join(lines), *arm, "--samples")
    assert np.median(np.diff(rows.t)) == pytest.approx(0.01) and len(rows) > 4000
    late = sorted(lines, key=lambda x: float(x.split(",")[1]) + 2.7 * x.startswith("gnss"))
    rows, said, _ = run_example(example, exported, "\n".join(late), *arm)
    assert "x taken late, and replayed" in said and rows.revised.sum() > 100
    last = rows.drop_duplicates("t", keep="last").sort_values("t")
    np.testing.assert_allclose(last[list(COLUMNS)], core.solution, rtol=1e-9, atol=1e-8)


def test_the_example_says_what_it_does_not_understand(exported, example, tables, tmp_path):
    write_log(tmp_path / "drive.csv", tables)
    lines = (tmp_path / "drive.csv").read_text().splitlines()
    for arguments, log, words in (
        (["--arm", "1", "0.3"], lines[:0], "navigate: --arm: take [--arm x y z, in metres]"),
        (["--arm", "1", "0,3", "-1"], lines[:0], "navigate: --arm: take [--arm"),
        (["--latncy"], lines[:0], "navigate: --latncy: take"),
        ([], ["t,x", *lines[:60], ""], "navigate: line 1 is not a measurement and is ignored: t,x\n"),
        ([], ["gnss,1,48,9,100,0,0,0.123456789012345678901234567890123456789012", ""], "12345678\nnavigate: a fix"),
        ([], ["gnss,1,48,9,100,0,0,0", *lines[:60]], "a fix has 14 values, this line has 7; write nan"),
        ([], ["imu,1,2,x,4,5,6,7"], "1 lines ignored"),
        ([], ["imu,1" + ",2" * 2000, "imu,1,2,3"], "2 lines ignored"),
        ([], [f"imu,{10 * k},0,0,-9.8,0,0,0" for k in range(60)], "a gap: are the stamps in seconds?"),
        ([], [f"imu,{k / 50},0,0,-1,0,0,0" for k in range(60)], "az is -1.00 m/s2 in the mean, must be near -9.8"),
        ([], lines[:60], "navigate: nothing solved, waiting for fixes over 3 seconds"),
        ([], [], "navigate: nothing solved, waiting for samples of the IMU"),
    ):
        given = {"input": "".join(f"{line}\n" for line in log), "env": {"LD_LIBRARY_PATH": str(exported[0])}}
        done = subprocess.run([example, *arguments], capture_output=True, text=True, **given)
        assert done.returncode == 2 and words in done.stderr, done.stderr
        assert len(done.stdout.splitlines()) == (0 if arguments else 1)  # the columns' names alone
    done = subprocess.run([example, "--help"], capture_output=True, text=True, check=True,
                          env={"LD_LIBRARY_PATH": str(exported[0])})  # fmt: skip
    assert "Exit code 0: solved" in done.stdout and "gnss,t,lat,lon,h" in done.stdout


def test_nothing_is_allocated(exported):
    folder = exported[0]
    command = ["nm", "-D", "--undefined-only", folder / LIBRARY]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    needed = {line.split()[-1].partition("@")[0] for line in listed.stdout.splitlines()}
    assert "sqrt" in needed or "sin" in needed  # it is the right list
    assert not needed & {"malloc", "calloc", "realloc", "free", "_Znwm", "posix_memalign", "aligned_alloc"}


def test_the_description_tells_every_number_of_the_memory(exported):
    folder, estimator, layout, _ = exported
    described = json.loads((folder / "step.json").read_text())
    assert sum(int(np.prod(f["shape"])) for f in described["memory"]["fields"]) == layout.size
    assert [column["name"] for column in described["row"]] == list(list_columns(estimator))
    assert all(x.get("meaning") for x in (*described["row"], *described["memory"]["fields"]))
    assert described["row"][5] == {"name": "vel_n", "place": 5, "meaning": "velocity North [m/s]"}
    header = (folder / "step.h").read_text()
    assert f"#define DLKF_MEMORY {layout.size}\n" in header and "@" not in header
    assert re.search(r"DLKF_LAT_DEG, DLKF_LON_DEG", header)


@pytest.mark.parametrize("kind", ["aekf_car_gated", "mbkf33_nhc_gated", "dlkf", "plus"])
def test_every_number_has_a_meaning(kind):
    made = {"dlkf": learned, "plus": talkative_plus}
    layout = make_layout(made[kind]() if kind in made else build_filter(kind, IMU), GRID)
    assert [f.name for f in layout.fields if not f.as_dict().get("meaning")] == []


def test_columns_say_axis_and_unit():
    said = {c: describe_column(c) for c in CORE_COLUMNS}
    assert said["std_gyro_error_z"] == "1σ of gyroscope error down, measured less true [rad/s]"
    assert said["innovation_std_pos_d"] == "1σ of fix less expected: position Down [m]"
    assert all(text.endswith("]") for c, text in said.items() if c not in ("revised", "gnss_used"))


def test_a_batch_through_the_compiled_filter(compiled, drive, monkeypatch):
    torch.manual_seed(0)
    ran, run = [], Library.run
    monkeypatch.setattr(Library, "run", lambda self, x, imu, fixes: (ran.append(len(imu)), run(self, x, imu, fixes))[1])
    batch = align_drives([drive], ALIGN).select(torch.zeros(3, dtype=torch.int64))
    available = torch.rand(batch.available.shape) < 0.7
    available[1, :20], available[2] = available[0, :20], available[0]  # what copies have in common is run once
    batch = replace(batch, available=available)
    want, got = (run_filter(batch, f) for f in (compiled.estimator, compiled))
    for name in ("imu_error", "innovation", "std"):
        torch.testing.assert_close(getattr(got, name), getattr(want, name), atol=ROUNDING, rtol=ROUNDING)
    for mine, theirs in zip((*got.prior, *got.posterior), (*want.prior, *want.posterior)):
        torch.testing.assert_close(mine, theirs, atol=ROUNDING, rtol=0)
    assert torch.equal(got.used, want.used)
    assert ran and sum(ran) <= 2 * batch.size[1] - 20
    assert run_filter(batch.in_precision(torch.float32), compiled).std.dtype == torch.float32


def test_drives_of_unlike_length_through_the_compiled_filter(compiled, drive):
    """As each by itself; beyond its end a drive has no fix."""
    whole, half = ([drive.part(0, n)] for n in (drive.epochs, drive.epochs // 2))
    both = run_filter(align_drives([*whole, *half], ALIGN), compiled)
    for row, one in enumerate((whole, half)):
        alone = run_filter(align_drives(one, ALIGN), compiled)
        n = alone.used.shape[1]
        for name in ("std", "innovation_covariance"):
            mine, theirs = getattr(both, name)[row, :n], getattr(alone, name)[0]
            torch.testing.assert_close(mine, theirs, atol=ROUNDING, rtol=ROUNDING)
        torch.testing.assert_close(both.posterior.p_n[row, :n], alone.posterior.p_n[0], atol=ROUNDING, rtol=ROUNDING)
    assert not both.used[1, n:].any() and not both.innovation[1, n:].any() and n < both.used.shape[1]


def test_a_stream_through_the_compiled_filter_and_another_frame(compiled, tables, drive):
    def solution(estimator) -> pd.DataFrame:
        stream = StreamingFilter(estimator, lever_arm_b=ARM, align=ALIGN, phase_s=drive.t0, anchor_m=100.0)
        return estimates_table(
            [e for receipt in replay_drive(stream, tables.imu, tables.gnss) for e in receipt.estimates]
        )

    want, got = solution(compiled.estimator), solution(compiled)
    assert len(want) > 40
    np.testing.assert_allclose(got.to_numpy(float), want.to_numpy(float), rtol=1e-6, atol=ROUNDING)


def test_a_logged_drive_through_the_core_is_that_through_the_stream(exported, tables):
    """As ``navigate streaming=true compiled=true`` takes it; with other settings of the start it is the stream."""
    _, estimator, layout, library = exported
    in_c = CompiledFilter(estimator, GRID, layout, library, whole=True)
    grid = {"rate_hz": 50.0, "epoch_s": 1.0}
    want, got = stream_drive(tables, estimator, **grid), run_core_drive(tables, in_c, **grid)
    assert list(got.table.columns) == list(want.table.columns) and got.table.gnss_used.dtype == bool
    np.testing.assert_allclose(got.table.to_numpy(float), want.table.to_numpy(float), rtol=1e-5, atol=ROUNDING)
    assert got.aligned_at == want.aligned_at and got.doubt == pytest.approx(want.doubt, rel=1e-6)
    other = run_core_drive(tables, in_c, **grid, align=ALIGN)
    assert other.doubt == 0.0 < got.doubt  # the course alone
    short = replace(tables, imu={c: x[:500] for c, x in tables.imu.items()})
    with pytest.raises(UnalignedError, match=r"never moves|no GNSS fix|is ambiguous"):
        run_core_drive(short, in_c, **grid)


def test_it_is_made_once_and_can_be_put_away(exported, tmp_path, monkeypatch):
    folder, estimator, _, _ = exported
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = tmp_path / "dlkf" / "compiled" / compiled_filter._digest(estimator, GRID)
    shutil.copytree(folder, kept)  # made before
    seal(kept)
    made = compiled_filter.compile_filter(estimator, 50.0, 1.0)
    again = pickle.loads(pickle.dumps(made))
    assert again.grid == made.grid and again.layout.size == made.layout.size
    assert compiled_filter._digest(build_filter("mbkf15", IMU), GRID) != kept.name


def test_one_library_serves_every_preset_and_every_factor():
    """The numeric settings of a filter are in its memory; a number of it in the code would make another filter."""
    other = ImuSpec(
        "b", SensorErrors(1e-3, 0.03, 2e-3, 600.0, 1e-3, 4e-3), SensorErrors(3e-5, 2e-3, 3e-4, 300.0, 0.0, 1e-3)
    )
    changed = Tuning(**{k: (0.9 if 0.9 <= x < 1 else 1.7) * x for k, x in Tuning().factors().items()})
    recorded = []
    for imu, tuning in ((IMU, Tuning()), (other, changed)):
        estimator = build_filter("aekf_car_gated", imu, tuning=tuning)  # everything that has factors
        with export_mode():
            turn = Turn(estimator, GRID, make_layout(estimator, GRID))
            graph = record(turn.eval())
        attributes = {node.target: getattr(graph, node.target) for node in graph.graph.nodes if node.op == "get_attr"}
        code = graph.code, {name: x.tolist() for name, x in attributes.items()}  # what C is written from
        recorded.append((code, estimator.code, compiled_filter._digest(estimator, GRID)))
    assert recorded[0] == recorded[1]


def test_noise_goes_with_the_drive_into_another_frame(drive):
    loud, quiet = (build_filter("mbkf15", IMU, tuning=Tuning(accel_noise=x)) for x in (9.0, 1.0))
    batch = align_drives([drive], ALIGN)
    memory, other = loud.begin(batch)[0], quiet.begin(batch)[0]
    moved = reanchor(memory, FrameChange(batch.frame, batch.frame), other)
    assert torch.equal(moved.windows.spread, memory.windows.spread)
    assert not torch.equal(moved.windows.spread, other.windows.spread)


def test_a_span_of_positions_begins_anew_in_another_frame(drive):
    """Its places are in the axes of the old one."""
    kalman, batch = build_filter("mbkf15_nhc", IMU), align_drives([drive], ALIGN)
    fresh = kalman.begin(batch)[0]
    (index,) = (k for k, x in enumerate(fresh.sources) if hasattr(x, "liveliness"))
    car = fresh.sources[index]
    level = car.liveliness
    old = level._replace(still_s=level.still_s + 3, span=level.span._replace(place=torch.zeros_like(level.span.place)))
    sources = (*fresh.sources[:index], car._replace(liveliness=old), *fresh.sources[index + 1 :])
    moved = reanchor(fresh._replace(sources=sources), FrameChange(batch.frame, batch.frame), fresh).sources[index]
    assert moved.liveliness.span.place.isnan().all() and (moved.liveliness.still_s == 3).all()


def test_what_does_not_fit_is_refused_in_a_line(compiled, drive, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="compiled for 50 samples"):
        compiled.begin(align_drives([drive_with(drive, 25)], ALIGN))
    with pytest.raises(InputError, match="smoothed"):
        compiled_filter.compile_filter(build_filter("mbkf15_rts", IMU), 50.0, 1.0)
    monkeypatch.setattr("dlkf.onboard.library.find_compiler", lambda: None)
    with pytest.raises(InputError, match="no C compiler"):
        build(tmp_path)


def drive_with(drive, samples: int):
    """Every second sample of a drive."""
    return replace(drive, imu=drive.imu[:, ::2][:, :samples], rate_hz=25.0)


def learned_kalman(base: str) -> LearnedKalmanFilter:
    """A small network beside a Kalman filter, whose heads have weights of some size."""
    torch.manual_seed(0)
    size = {"lstm_hidden": 12, "lstm_layers": 2, "dense": [10, 8]}
    settings = {"network": size, "frame": "heading", "imu_error": "affine", "imu_error_bound": 4.0, "base": base}
    config = LearnedKalmanConfig.from_mapping(settings).with_base(IMU, Tuning(), None)
    model = LearnedKalmanFilter(config).eval()
    with torch.no_grad():
        model.gain.linear.weight.mul_(20)
        model.imu_error.linear.weight.mul_(20)
    return model


def learned(**settings) -> LearnedFilter:
    torch.manual_seed(0)
    network = {"cnn_channels": 4, "lstm_hidden": 8, "lstm_layers": 2, "dense": [16, 8]}
    return LearnedFilter(LearnedConfig.from_mapping({"network": network, **settings})).eval()


def talkative_plus() -> PlusFilter:
    """A network that says something."""
    torch.manual_seed(0)
    model = PlusFilter(PlusConfig()).eval()
    torch.nn.init.normal_(model.network.noise.weight, std=0.05)
    return model


def test_many_drives_through_a_large_network_go_through_torch(drive, monkeypatch):
    model = learned()
    layout = make_layout(model, GRID)
    monkeypatch.setattr(compiled_filter, "LARGE", sum(p.numel() for p in model.parameters()) - 1)
    in_c = CompiledFilter(model, GRID, layout, None)  # would be called for fewer
    batch = align_drives([drive], ALIGN)
    with pytest.raises(AttributeError, match="run"):
        run_filter(batch, in_c)
    many = batch.select(torch.zeros(compiled_filter.MANY, dtype=torch.int64))
    want, got = (run_filter(many, f) for f in (model, in_c))
    assert torch.equal(got.posterior.p_n, want.posterior.p_n)


@pytest.mark.exports
def test_ten_hours_with_one_call_in_twenty_faulty(exported, tmp_path):
    """36,000 update intervals in C, allocations counted by the program's own allocator; it still knows where it is."""
    folder, *_ = exported
    files = Path(__file__).with_name("ten_hours.c"), folder / LIBRARY, "-o", tmp_path / "go", "-lm"
    subprocess.run([find_compiler(), "-O2", f"-I{folder}", *files], check=True)
    message = {"capture_output": True, "text": True, "check": True}
    said = subprocess.run([tmp_path / "go"], env={"LD_LIBRARY_PATH": str(folder)}, timeout=PATIENCE_S, **message).stdout
    rows, faults, allocations, more_kB, off = (float(x) for x in re.findall(r"[\d.]+(?= )", said))
    assert rows > 35_900 and faults > 80_000 and allocations == 0
    assert more_kB <= 64  # pages of the stack that are touched late
    assert off < 2.0  # fixes of 1 m, and circles by a clock that knows no Earth rate


INCLUDED = (
    "geometry_msgs/msg/quaternion_stamped.hpp", "geometry_msgs/msg/twist_stamped.hpp",
    "geometry_msgs/msg/twist_with_covariance_stamped.hpp", "nav_msgs/msg/odometry.hpp", "rclcpp/rclcpp.hpp",
    "sensor_msgs/msg/fluid_pressure.hpp", "sensor_msgs/msg/imu.hpp", "sensor_msgs/msg/nav_sat_fix.hpp",
)  # fmt: skip


@pytest.mark.exports
def test_the_ros_2_node_says_what_the_example_does(exported, example, tables, tmp_path):
    """With what it takes of ROS 2 in ros2.hpp, never built with ROS 2 itself. Late fixes change nothing in the end."""
    folder, *_ = exported
    cxx = shutil.which("c++") or shutil.which("g++")
    if cxx is None:
        pytest.skip("no C++ compiler here")
    for name in INCLUDED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('#include "ros2.hpp"\n')
    here = Path(__file__).parent
    flags = ["-std=c++17", "-O2", "-Wall", "-Werror", *(f"-I{x}" for x in (folder, tmp_path, here, EXAMPLES))]
    subprocess.run([cxx, *flags, here / "ros2_log.cpp", folder / LIBRARY, "-o", tmp_path / "node"], check=True)
    write_log(tmp_path / "drive.csv", tables)
    lines = [x.split(",") for x in (tmp_path / "drive.csv").read_text().splitlines()]
    lines = [[*x[:11], "nan", "nan", "nan", "1"] if x[0] == "gnss" else x for x in lines]  # what a node does not get
    lines = [x if x[0] in ("gnss", "imu") else x[:3] for x in lines]

    def log(late: float) -> str:
        order = sorted(lines, key=lambda x: float(x[1]) + (late if x[0] == "gnss" else 0.0))
        return "".join(f"{','.join(x)}\n" for x in order)

    for late in (0.0, 0.3):
        given = {"input": log(late), "capture_output": True, "text": True, "check": True}
        said = subprocess.run([tmp_path / "node", *map(str, ARM)], env={"LD_LIBRARY_PATH": str(folder)}, **given).stdout
        got = np.array([[float(x) for x in line.split(",")] for line in said.splitlines()])
        want = run_example(example, exported, log(late), "--arm", *map(str, ARM), "--samples")[0]
        want = want[want.revised == 0].reset_index(drop=True)
        assert len(got) == len(want) > 4000
        np.testing.assert_allclose(got[:, 0], want.t, atol=1e-6)
        position = want[["lat_deg", "lon_deg", "height_m", "vel_n", "vel_e"]]
        np.testing.assert_allclose(got[:, [2, 1, 3, 9, 8]], position, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(-got[:, 10], want.vel_d, rtol=1e-9, atol=1e-8)
        turned = Rotation.from_euler("ZYX", want[["yaw", "pitch", "roll"]]).as_matrix()  # body FRD to NED
        ned, frd = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
        np.testing.assert_allclose(Rotation.from_quat(got[:, [5, 6, 7, 4]]).as_matrix(), ned @ turned @ frd, atol=1e-8)


KINDS = [
    "ins", "aekf", "mbkf21_car", "mbkf33_nhc_gated", "dlkf_literal", "dlkf", "dlkf_kalman_car", "dlkf_kalman",
    "plus",
]  # fmt: skip


@pytest.mark.exports
@pytest.mark.parametrize(
    "estimator",
    [
        *(lambda n=n: build_filter(n, IMU) for n in ("ins", "aekf", "mbkf21_car", "mbkf33_nhc_gated")),
        learned,
        lambda: learned(outage_mode="run", frame="heading", imu_error="affine", imu_error_bound=4.0),
        lambda: learned_kalman("mbkf21_car"),
        lambda: learned_kalman("mbkf33_gated"),
        talkative_plus,
    ],
    ids=KINDS,
)
def test_every_kind_of_filter(estimator, tables, drive, tmp_path):
    model = estimator()
    layout = write_source(tmp_path, model, GRID, "tested", {})
    found = measure_difference(model, Library(build(tmp_path, flags=QUICK), layout.size), tables, drive)
    single = isinstance(model, torch.nn.Module)  # a network's float32
    assert max(found.largest.values()) < (1e-3 if single else ROUNDING)
