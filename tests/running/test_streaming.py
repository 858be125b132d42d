"""The streaming filter against the batch run, and what a vehicle does to it: late, lost, bad and endless data."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from dlkf.data.alignment import AlignConfig
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import DriveTables, read_checked
from dlkf.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.plus import PARTS, PlusConfig, PlusFilter
from dlkf.navigation.earth import tangent_frame
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import NavState
from dlkf.running.estimate import estimates_table
from dlkf.running.offline import navigate_drives
from dlkf.running.reanchoring import FrameChange
from dlkf.running.replay import played, stream_drive, stream_drives
from dlkf.running.streaming import Status, StreamingFilter
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig

IMU = ImuSpec(
    "mems", SensorErrors(2.5e-3, 0.02, 1e-3, 3600.0, 3e-3, 3e-3), SensorErrors(9e-5, 1e-3, 1e-4, 3600.0, 3e-3, 3e-3)
)
ARM = (1.0, 0.3, -1.2)
EARTH = 6.37e6  # m per radian


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Two drives of a minute, an antenna away from the IMU."""
    folder = tmp_path_factory.mktemp("town")
    config = DatasetConfig("town", hours=2 / 60, drive_minutes=1.0, gnss=GnssConfig(lever_arm_b=ARM))
    return simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)


@pytest.fixture(scope="module")
def drive(town) -> DriveTables:
    """A minute; the car drives off after 7 s."""
    return read_checked(town, drive_rows(town)[0])


@pytest.fixture(scope="module")
def piece(drive) -> DriveTables:
    """Its first 35 s."""
    return until(drive, 35.0)


def network(**settings) -> LearnedFilter:
    """A small one whose heads have weights of some size, so that differences show."""
    torch.manual_seed(0)
    size = {"lstm_hidden": 16, "lstm_layers": 2, "dense": [24, 12]}
    model = LearnedFilter(LearnedConfig.from_mapping({"network": size, **settings})).eval()
    with torch.no_grad():
        model.gain.linear.weight.mul_(20)
        model.imu_error.linear.weight.mul_(50)
    return model.double()


def plus() -> PlusFilter:
    """A small one with weights, whose speed takes part."""
    torch.manual_seed(0)
    model = PlusFilter(PlusConfig.from_mapping({"parts": PARTS, "network": {"hidden": 16}})).eval()
    for p in model.network.noise.parameters():
        torch.nn.init.normal_(p, std=0.2)
    return model.double()


def estimator(name: str):
    if name == "plus":
        return plus()
    return network(outage_mode=name[4:]) if name.startswith("net_") else build_filter(name, IMU)


def batch(tables: DriveTables, name: str) -> pd.DataFrame:
    whole = drive_from_tables(tables, "", 50.0, 1.0, torch.float64)
    return next(iter(navigate_drives([whole], estimator(name)))).table


def apart(a: pd.DataFrame, b: pd.DataFrame) -> float:
    """Largest difference of two solutions in any column; angles of position in metres."""
    assert len(a) == len(b) > 0
    scale = {"lat_deg": np.radians(EARTH), "lon_deg": np.radians(EARTH)}
    return max(float((a[c].astype(float) - b[c].astype(float)).abs().mul(scale.get(c, 1.0)).max()) for c in a
               if c != "geometry" and not a[c].isna().all())  # fmt: skip


def table(stream: StreamingFilter, tables: DriveTables, **arrivals) -> pd.DataFrame:
    """All that a stream said of a drive, late fixes included."""
    found = {}
    for receipt in played(stream, tables.imu, tables.gnss, **arrivals):
        found.update((e.t, e) for e in receipt.estimates)
    return estimates_table(found[t] for t in sorted(found))


def some(tables: DriveTables, keep: np.ndarray, kind: str) -> DriveTables:
    return replace(tables, **{kind: {name: x[keep] for name, x in getattr(tables, kind).items()}})


def until(tables: DriveTables, t: float) -> DriveTables:
    for kind in ("imu", "gnss", "reference"):
        tables = some(tables, getattr(tables, kind)["t"] <= t + 1e-6, kind)
    return tables


# The same operations on the same numbers but for the rounding of sums over the samples and of the grid's times: 1e-13
# of values of 10, of latitudes of 1 rad 1e-9 m, which 90 closed-loop epochs do not let grow. A jump would show.
ROUNDING = 1e-8


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_nhc", "mbkf15_gated", "net_hold", "net_run", "plus"])
def test_a_stream_gives_the_batch_s_solution(piece, name):
    """At the first try, and when fixes come late and out of order from before the alignment on."""
    whole = batch(piece, name)
    t = piece.gnss["t"]
    for arrival in (None, t + np.random.default_rng(0).uniform(0, 3, len(t))):
        found = stream_drive(piece, estimator(name), rate_hz=50.0, epoch_s=1.0, arrival=arrival).table
        assert apart(found, whole) < ROUNDING
    assert whole.gnss_used.mean() > 0.9


def test_any_stamps(piece):
    """An IMU that jitters and loses samples; fixes at 2 Hz off the boundaries, without std, one without velocity."""
    g = np.random.default_rng(1)
    t = piece.imu["t"]
    imu = {**piece.imu, "t": t + g.uniform(-2e-3, 2e-3, len(t))}
    gnss = {**piece.gnss, "t": piece.gnss["t"] + g.normal(0.3, 0.02, len(piece.gnss["t"]))}
    gnss["std_pos_n"], gnss["std_vel_d"] = (np.full(len(gnss["t"]), np.nan) for _ in range(2))
    gnss["vel_e"] = np.where(np.arange(len(gnss["t"])) == 30, np.nan, gnss["vel_e"])
    tables = replace(some(replace(piece, imu=imu), g.random(len(t)) > 0.02, "imu"), gnss=gnss)
    found = stream_drive(tables, estimator("mbkf15"), rate_hz=50.0, epoch_s=1.0).table
    assert apart(found, batch(tables, "mbkf15")) < ROUNDING


def test_a_stream_finds_the_grid_of_regular_fixes_by_itself(piece):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    assert stream.aligning and stream.now() is None
    assert apart(table(stream, piece), batch(piece, "mbkf15")) < ROUNDING
    assert not stream.aligning and stream.latest.row["std_yaw"] < 0.05
    assert apart(pd.DataFrame([stream.latest.row]), batch(piece, "mbkf15").tail(1).reset_index(drop=True)) < ROUNDING


def test_a_long_wait_for_the_first_fix_costs_no_memory(piece):
    """Nothing for 20 s, then regular fixes: as the batch run, which starts as soon as it has two."""
    tables = some(piece, piece.gnss["t"] > 19.5, "gnss")
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    for _ in played(stream, until(tables, 19.9).imu, {c: x[:0] for c, x in tables.gnss.items()}):
        assert len(stream._samples._rows) <= 1002
    rest = some(tables, tables.imu["t"] > 19.9, "imu")
    assert apart(table(stream, rest), batch(tables, "mbkf15")) < ROUNDING


def test_between_epochs_the_state_is_carried_to_the_latest_sample(drive):
    """Against the reference at 10 Hz: no worse between epochs than just before their end."""
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    at = dict(zip(np.round(drive.reference["t"], 6).tolist(), np.arange(len(drive.reference["t"]))))
    wrong = {True: [], False: []}
    for _ in played(stream, drive.imu, drive.gnss):
        t = round(stream._samples.latest, 6)
        if t < 35 or t not in at:
            continue
        now = stream.now()
        assert now.t == stream._samples.latest
        row, k = now.row, at[t]
        v = np.array([row[f"vel_{a}"] - drive.reference[f"vel_{a}"][k] for a in "ned"])
        north = np.radians(row["lat_deg"] - drive.reference["lat_deg"][k]) * EARTH
        turn = np.remainder(row["yaw"] - drive.reference["yaw"][k] + np.pi, 2 * np.pi) - np.pi
        wrong[abs(t - round(t)) < 0.05].append([north, np.abs(v).max(), turn])
    ends, between = (np.sqrt(np.mean(np.square(wrong[x]), 0)) for x in (True, False))
    assert len(wrong[False]) > 200 and (ends < [0.05, 0.05, 0.02]).all()
    assert (between < 1.5 * ends).all()


def test_bad_packets_are_refused_and_change_nothing(piece):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    still, turn = (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)
    here = [float(piece.gnss[c][25]) for c in ("lat_deg", "lon_deg", "height_m")]
    reasons, found = [], []
    for receipt in played(stream, piece.imu, piece.gnss):
        found += receipt.estimates
        t = stream._samples.latest
        if abs(t - 25.5) > 0.001 or reasons:
            continue
        bad = [
            stream.imu(t, still, turn), stream.imu(t - 9, still, turn), stream.imu(t + 1e6, still, turn),
            stream.imu(np.nan, still, turn), stream.imu(t + 0.005, np.full(3, np.nan), turn),
            stream.gnss(np.nan, *here), stream.gnss(t, np.nan, *here[1:]), stream.gnss(t, *here, quality=0),
            stream.gnss(t, 95.0, *here[1:]), stream.gnss(t, *here, std=[-1.0] * 6), stream.gnss(t, *here, std=[1.0]),
            stream.gnss(25.0, *here), stream.gnss(t - 30, *here), stream.gnss(t + 100, *here),
            stream.gnss(t, *here[:2], np.inf),
        ]  # fmt: skip
        assert all(r.status is Status.REFUSED and r.reason and not r.estimates for r in bad)
        reasons += [r.reason for r in bad]
    assert len(reasons) == 15 and stream.counts["refused"] == 15
    for words in ("again", "goes back", "gap", "finite", "no fix", "±90", "std", "late", "ahead"):
        assert any(words in r for r in reasons), words
    assert apart(estimates_table(found), batch(piece, "mbkf15")) < ROUNDING


def test_a_fix_later_than_the_history_is_refused(drive):
    """Fixes from 30 to 35 s come 8 s late, the memory is 4 s: the solution without them."""
    t = drive.gnss["t"]
    tardy = (t > 29.5) & (t < 35.5)
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM, history_s=4.0)
    found = table(stream, drive, arrival=t + np.where(tardy, 8.2, 0.0))
    assert stream.counts["refused"] == tardy.sum() == 6
    assert apart(found, batch(some(drive, ~tardy, "gnss"), "mbkf15")) < ROUNDING


def test_of_several_fixes_in_an_epoch_the_latest_counts(piece):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    found = []
    for receipt in played(stream, piece.imu, piece.gnss):
        found += receipt.estimates
        if receipt.status is Status.TAKEN and 25.0 < stream._samples.latest < 25.015:
            assert stream.gnss(24.7, 50.0, 8.0, 100.0).status is Status.SUPERSEDED
            assert stream.gnss(24.7, 50.0, 8.0, 100.0).status is Status.SUPERSEDED
    assert apart(estimates_table(found), batch(piece, "mbkf15")) < ROUNDING


@pytest.mark.parametrize("jump", [5.0, -1000.0])
def test_after_a_long_gap_or_a_new_clock_it_starts_over(drive, jump):
    """Five seconds without IMU, or a clock that starts anew: refused for a second, then aligned again."""
    kept = (drive.imu["t"] < 20) | (drive.imu["t"] > 25)
    late_imu, late_fix = (np.where(x["t"] > 22, jump - 5.0, 0.0) for x in (drive.imu, drive.gnss))
    imu = {**drive.imu, "t": drive.imu["t"] + late_imu}
    gnss = {**drive.gnss, "t": drive.gnss["t"] + late_fix}
    arrival = drive.gnss["t"]
    tables = some(replace(drive, imu=imu, gnss=gnss), kept, "imu")
    stream, restarts, rows = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM), [], {}
    fixes, k = [{c: x[j] for c, x in tables.gnss.items()} for j in range(len(arrival))], 0
    for j, t in enumerate(drive.imu["t"][kept].tolist()):
        while k < len(arrival) and arrival[k] <= t:
            f = fixes[k]
            velocity = [f["vel_n"], f["vel_e"], f["vel_d"]]
            stream.gnss(f["t"], f["lat_deg"], f["lon_deg"], f["height_m"], velocity, quality=4)
            k += 1
        sample = [float(tables.imu[f"{s}_{a}"][j]) for s in ("accel", "gyro") for a in "xyz"]
        receipt = stream.imu(float(tables.imu["t"][j]), sample[:3], sample[3:])
        if receipt.status is Status.RESTARTED:
            restarts.append((t, receipt.reason))
            assert stream.aligning and stream.latest is None
        rows.update((round(t, 2), e) for e in receipt.estimates)
    assert len(restarts) == 1 and 26 <= restarts[0][0] < 26.1
    assert ("gap" if jump > 0 else "goes back") in restarts[0][1]
    assert not [t for t in rows if 20.1 < t < 26] and min(t for t in rows if t > 26) < 33
    last = stream.latest.row
    k = int(np.searchsorted(drive.reference["t"], 59.999))
    assert abs(np.radians(last["lat_deg"] - drive.reference["lat_deg"][k]) * EARTH) < 0.2


@pytest.mark.parametrize("fault", ["nan", "singular"])
def test_a_diverged_filter_starts_over(piece, fault):
    """The 15th epoch's answer is not finite, or its innovation covariance cannot be factored."""

    class Failing(type(estimator("mbkf15"))):
        def step(self, memory, epoch):
            memory, answer = super().step(memory, epoch)
            calls.append(1)
            if len(calls) == 15:
                if fault == "singular":
                    torch.linalg.cholesky(-torch.eye(6))
                answer = answer._replace(dx=answer.dx * torch.nan)
            return memory, answer

    calls: list[int] = []
    stream = StreamingFilter(Failing(IMU), lever_arm_b=ARM)
    found = [e.t for r in played(stream, piece.imu, piece.gnss) for e in r.estimates]
    assert stream.counts["diverged"] == 1 and np.diff(found).max() == 2.0 and found[-1] == 35.0
    assert np.isfinite(stream.latest.row["lat_deg"])


def test_memory_does_not_grow_and_the_covariance_stays_one(piece):
    """Everything that a stream holds, written out, from 18 s to 35 s; late fixes keep the history busy."""
    for name in ("mbkf15", "net_run"):
        stream, sizes = StreamingFilter(estimator(name), lever_arm_b=ARM, history_s=3.0), []
        for receipt in played(stream, piece.imu, piece.gnss, piece.gnss["t"] + 1.3):
            if receipt.status is Status.REPLAYED and stream._samples.latest > 18:
                sizes.append(len(pickle.dumps(stream)))
            if receipt.estimates and name == "mbkf15":
                P = stream._running.memory.P[0]
                sigma = P.diagonal().sqrt()
                assert torch.equal(P, P.mT) and torch.linalg.eigvalsh(P / torch.outer(sigma, sigma))[0] > 0
        assert len(sizes) > 15 and max(sizes) < 1.05 * min(sizes)
        assert len(stream._closed) == 8 and len(stream._fixes) <= 10


def test_put_away_and_taken_up_again_it_goes_on(piece):
    stream = StreamingFilter(estimator("mbkf21_nhc"), lever_arm_b=ARM)
    rows, fixes = piece.imu["t"] < 20.3, piece.gnss["t"] < 20.3
    first = some(some(piece, rows, "imu"), fixes, "gnss")
    then = some(some(piece, ~rows, "imu"), ~fixes, "gnss")
    before = table(stream, first)
    after = table(pickle.loads(pickle.dumps(stream)), then)
    assert apart(pd.concat((before, after), ignore_index=True), batch(piece, "mbkf21_nhc")) < ROUNDING


@pytest.mark.parametrize(
    "name,metres",
    # with an outage of 25 s: gravity is good to 1e-8 m/s² within a kilometre, the linear model to its square
    [("mbkf21_nhc_gated", 1e-4), ("plus", 2e-3), ("aekf", 1e-2), ("ins", 2e-2)],
)
def test_moving_the_frame_along_changes_nothing(drive, name, metres):
    tables = some(drive, (drive.gnss["t"] < 25) | (drive.gnss["t"] > 50), "gnss")
    still, moving = (StreamingFilter(estimator(name), lever_arm_b=ARM, anchor_m=m) for m in (1e9, 100.0))
    late = 2.2 if "gated" in name else 0.0  # a replay may cross a change of frame
    a, b = (table(s, tables, arrival=tables.gnss["t"] + late) for s in (still, moving))
    columns = [c for c in a if not c.startswith("std")]  # those of vectors turn as if uncorrelated
    assert apart(a[columns], b[columns]) < metres
    assert float(moving.latest.state.p_n.norm()) < 150 < float(still.latest.state.p_n.norm())


def test_a_network_of_the_heading_frame_moves_along(drive):
    """What it sees of the tilt of n against the vertical, 1e-4 rad here, is all that differs."""
    still, moving, blind = (
        StreamingFilter(network(frame=f, outage_mode="run"), lever_arm_b=ARM, anchor_m=m)
        for f, m in (("heading", 1e9), ("heading", 100.0), ("ned", 100.0))
    )
    a, b, other = (table(s, drive) for s in (still, moving, blind))
    assert apart(a[["lat_deg", "lon_deg"]], b[["lat_deg", "lon_deg"]]) < 0.1
    assert np.isfinite(other["lat_deg"]).all() and float(blind.latest.state.p_n.norm()) < 200


def test_a_change_of_frame_keeps_position_velocity_and_attitude_in_ecef():
    g = torch.Generator().manual_seed(0)
    one = torch.ones(3, dtype=torch.float64)
    old, new = (tangent_frame(lat * one, lon * one, 100 * one) for lat, lon in ((0.9, 0.2), (0.91, 0.21)))
    p, v = (1e4 * torch.randn(3, 3, generator=g, dtype=torch.float64) for _ in range(2))
    C = torch.linalg.qr(torch.randn(3, 3, 3, generator=g, dtype=torch.float64))[0]
    L = torch.randn(3, 16, 16, generator=g, dtype=torch.float64)
    change, state = FrameChange(old, new), NavState(p, v, C)
    moved = change.state(state)
    assert (new.to_ecef(moved.p_n) - old.to_ecef(p)).abs().max() < 1e-8
    assert (new.rotate_to_ecef(moved.v_n) - old.rotate_to_ecef(v)).abs().max() < 1e-8
    assert (new.C_en @ moved.C_nb - old.C_en @ C).abs().max() < 1e-14
    # an error x with covariance P is the vector x' = T x: its normalised square does not change
    P, x = L @ L.mT, torch.randn(3, 16, generator=g, dtype=torch.float64)
    turned = torch.cat((change.vectors(x[:, :9]), x[:, 9:]), -1)
    a, b = ((y * torch.linalg.solve(Q, y)).sum(-1) for y, Q in ((x, P), (turned, change.covariance(P))))
    assert torch.allclose(a, b, rtol=1e-6)


def test_outliers_a_frozen_receiver_and_a_gap_are_survived(drive):
    """100 m off in one fix of six, the same fix for 8 s, none for 12 s: the gated filter comes back by itself."""
    gnss = {name: x.copy() for name, x in drive.gnss.items()}
    t = gnss["t"]
    gnss["lat_deg"][(t % 6 == 3) & (t < 28)] += np.degrees(100 / EARTH)
    frozen = (t > 28) & (t <= 36)
    for name in set(gnss) - {"t"}:
        gnss[name][frozen] = gnss[name][t == 28]
    tables = some(replace(drive, gnss=gnss), (t < 43) | (t > 55), "gnss")
    found = table(StreamingFilter(estimator("mbkf15_gated"), lever_arm_b=ARM), tables)
    truth = np.interp(found.t, drive.reference["t"], drive.reference["lat_deg"])
    wrong = np.abs(np.radians(found.lat_deg - truth)) * EARTH

    def worst(first: float, last: float) -> float:
        return float(wrong[(found.t >= first) & (found.t <= last)].max())

    assert worst(12, 28) < 0.5  # the outliers at 15, 21 and 27 s
    assert 0.2 < worst(29, 36) < 20 and worst(38, 42) < 0.5  # adrift, and back
    assert worst(43, 55) < 20 and worst(57, 60) < 0.5


def test_a_filter_that_does_not_fit_is_told_at_once():
    with pytest.raises(InputError, match="rate_hz"):
        StreamingFilter(network(), rate_hz=100.0)
    with pytest.raises(InputError, match="whole number"):
        StreamingFilter(estimator("ins"), rate_hz=50.0, epoch_s=0.33)
    with pytest.raises(InputError, match="history_s"):
        StreamingFilter(estimator("ins"), history_s=-1.0)


def test_without_motion_it_goes_on_aligning(piece):
    stream = StreamingFilter(estimator("ins"), lever_arm_b=ARM, align=AlignConfig(min_speed=1000.0))
    assert not any(r.estimates for r in played(stream, piece.imu, piece.gnss))
    assert stream.aligning and stream.now() is None and len(stream._samples._rows) < 200


def test_a_dataset_through_streams(town):
    """As ``navigate``: both drives, and the same line of report but for the innovations, which a stream does not keep;
    a drive that cannot be aligned is left out."""
    filters = estimator("mbkf15")
    streamed = {r.drive: r for r in stream_drives(town, filters, rate_hz=50.0, epoch_s=1.0)}
    drives = [drive_from_tables(read_checked(town, row), "", 50.0, 1.0, torch.float64) for row in drive_rows(town)]
    for whole in navigate_drives(drives, filters):
        found = streamed[whole.drive]
        assert found.summary() == whole.summary().partition(", innovations")[0]
        assert apart(found.table, whole.table) < ROUNDING
    tables = read_checked(town, drive_rows(town)[0])
    still = {**tables.gnss, **{f"vel_{a}": 0 * tables.gnss["t"] for a in "ned"}}
    with pytest.raises(InputError, match="never moves"):
        stream_drive(replace(tables, gnss=still), filters, rate_hz=50.0, epoch_s=1.0)


def test_navigate_streams(town, drive, tmp_path):
    call = [sys.executable, "-m", "dlkf.navigate", "model=ins", "streaming=true", f"drives=[{drive.row.name}]"]
    done = subprocess.run([*call, f"dataset={town}", "out=made"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = pd.read_parquet(tmp_path / "made" / f"drive={drive.row.name}" / "solution.parquet")
    assert apart(found, batch(drive, "ins")) < 1e-5  # 3 km adrift after a minute without a correction
