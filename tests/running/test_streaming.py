"""The streaming filter against the batch run."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.schema import POSITION
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_drive
from dlkf.running.offline import navigate_drives
from dlkf.running.replay import replay_drive, stream_drive, stream_drives
from dlkf.running.solution import estimates_table
from dlkf.running.streaming import Status, StreamingFilter
from tests.running.streams import ARM, EARTH, ROUNDING, apart, batch, estimator, some, table


@pytest.mark.parametrize("name", ["mbkf21_nhc", "mbkf15_gated", "net_run", "dlkf_kalman_mbkf21_car", "plus"])
def test_a_stream_gives_the_batch_s_solution(segment, name):
    """At the first try, and when fixes come late and out of order from before the alignment on."""
    whole = batch(segment, name)
    t = segment.gnss["t"]
    for arrival in (None, t + np.random.default_rng(0).uniform(0, 3, len(t))):
        found = stream_drive(segment, estimator(name), rate_hz=50.0, epoch_s=1.0, arrival=arrival).table
        assert apart(found, whole) < ROUNDING
    assert whole.gnss_used.mean() > 0.9


def test_any_stamps(segment):
    """An IMU that jitters and loses samples; fixes at 2 Hz off the boundaries, without std, one without velocity."""
    g = np.random.default_rng(1)
    t = segment.imu["t"]
    imu = {**segment.imu, "t": t + g.uniform(-2e-3, 2e-3, len(t))}
    gnss = {**segment.gnss, "t": segment.gnss["t"] + g.normal(0.3, 0.02, len(segment.gnss["t"]))}
    gnss["std_pos_n"], gnss["std_vel_d"] = (np.full(len(gnss["t"]), np.nan) for _ in range(2))
    gnss["vel_e"] = np.where(np.arange(len(gnss["t"])) == 30, np.nan, gnss["vel_e"])
    tables = replace(some(replace(segment, imu=imu), g.random(len(t)) > 0.02, "imu"), gnss=gnss)
    found = stream_drive(tables, estimator("mbkf15"), rate_hz=50.0, epoch_s=1.0).table
    assert apart(found, batch(tables, "mbkf15")) < ROUNDING


def test_a_stream_finds_the_grid_of_regular_fixes_by_itself(segment):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    assert stream.aligning and stream.now() is None
    assert apart(table(stream, segment), batch(segment, "mbkf15")) < ROUNDING
    assert not stream.aligning and stream.latest.row["std_yaw"] < 0.05
    assert apart(pd.DataFrame([stream.latest.row]), batch(segment, "mbkf15").tail(1).reset_index(drop=True)) < ROUNDING


def test_spikes_are_left_out_as_in_a_log(segment):
    """The last, the last but one and the first sample of an epoch, and some others: the solution of a log, and nearly
    that without spikes."""
    imu = {name: x.copy() for name, x in segment.imu.items()}
    at = np.searchsorted(imu["t"], [14.0 - 1e-6, 16.99 - 1e-6, 20.01 - 1e-6, 22.5, 25.0 - 1e-6, 28.0 - 1e-6, 30.37])
    imu["gyro_z"][at] += np.where(np.arange(len(at)) % 2, 1.0, -2.0)
    imu["accel_x"][at[::2]] += 30.0
    spoiled, stream = replace(segment, imu=imu), StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    found, clean = table(stream, spoiled), batch(segment, "mbkf15")
    assert apart(found, batch(spoiled, "mbkf15")) < ROUNDING
    assert stream.counts["spikes"] == len(at)
    turned = np.remainder(found.yaw - clean.yaw + np.pi, 2 * np.pi) - np.pi
    assert 0 < np.abs(turned).max() < 1e-3  # a sample of 2 rad/s is 0.02 rad


def test_between_epochs_the_state_is_carried_to_the_latest_sample(drive):
    """Against the reference at 10 Hz: no worse between epochs than just before their end."""
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    at = dict(zip(np.round(drive.reference["t"], 6).tolist(), np.arange(len(drive.reference["t"]))))
    wrong = {True: [], False: []}
    for _ in replay_drive(stream, drive.imu, drive.gnss):
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


def test_of_several_fixes_in_an_epoch_the_latest_counts(segment):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    found, statuses = [], []
    at_25 = [float(segment.gnss[c][segment.gnss["t"] == 25.0][0]) for c in POSITION]
    for receipt in replay_drive(stream, segment.imu, segment.gnss):
        found += receipt.estimates
        if receipt.status is Status.TAKEN and 25.0 < stream._samples.latest < 25.015:
            others = ((t, at_25[0] + 1e-7, *at_25[1:]) for t in (24.7, 24.6, 24.7))
            statuses += [stream.gnss(*fix).status for fix in others]
            assert stream.gnss(24.5, 50.0, 8.0, 100.0).reason.endswith("implausible jump")
    assert statuses == [Status.SUPERSEDED, Status.SUPERSEDED, Status.REFUSED]
    assert apart(estimates_table(found), batch(segment, "mbkf15")) < ROUNDING


def test_memory_does_not_grow_and_the_covariance_stays_one(segment):
    """Everything that a stream holds, written out, from 26 s to 35 s; late fixes keep the history busy."""
    for name in ("mbkf15", "net_run"):
        stream, sizes = StreamingFilter(estimator(name), lever_arm_b=ARM, history_s=3.0), []
        for receipt in replay_drive(stream, segment.imu, segment.gnss, segment.gnss["t"] + 1.3):
            if receipt.status is Status.REPLAYED and stream._samples.latest > 26:
                sizes.append(len(pickle.dumps(stream)))
            if receipt.estimates and name == "mbkf15":
                P = stream._epochs.running.memory.P[0]
                sigma = P.diagonal().sqrt()
                assert torch.equal(P, P.mT) and torch.linalg.eigvalsh(P / torch.outer(sigma, sigma))[0] > 0
        assert len(sizes) > 5 and max(sizes) < 1.05 * min(sizes)
        assert len(stream._epochs.closed) == 18 and len(stream._buffer._fixes) <= 20


def test_put_away_and_taken_up_again_it_goes_on(segment):
    stream = StreamingFilter(estimator("mbkf21_nhc"), lever_arm_b=ARM)
    rows, fixes = segment.imu["t"] < 20.3, segment.gnss["t"] < 20.3
    first = some(some(segment, rows, "imu"), fixes, "gnss")
    then = some(some(segment, ~rows, "imu"), ~fixes, "gnss")
    before = table(stream, first)
    after = table(pickle.loads(pickle.dumps(stream)), then)
    assert apart(pd.concat((before, after), ignore_index=True), batch(segment, "mbkf21_nhc")) < ROUNDING


def test_a_dataset_through_streams(streets):
    """As ``navigate``: both drives, and the same line of report but for the innovations, which a stream does not keep;
    a drive that cannot be aligned is left out."""
    filters = estimator("mbkf15")
    streamed = {r.drive: r for r in stream_drives(streets, filters, rate_hz=50.0, epoch_s=1.0)}
    checked = [read_drive(streets, row) for row in drive_rows(streets)]
    drives = [drive_from_tables(one, "", 50.0, 1.0, torch.float64) for one in checked]
    for whole in navigate_drives(drives, filters):
        found = streamed[whole.drive]
        assert found.summary() == whole.summary().partition(", normalised innovation")[0]
        assert apart(found.table, whole.table) < ROUNDING
    tables = checked[0]
    still = {**tables.gnss, **{f"vel_{a}": 0 * tables.gnss["t"] for a in "ned"}}
    with pytest.raises(InputError, match="never moves"):
        stream_drive(replace(tables, gnss=still), filters, rate_hz=50.0, epoch_s=1.0)


def test_navigate_streams(streets, drive, call, tmp_path):
    one = ("streaming=true", f"drives=[{drive.row.name}]", f"dataset={streets}")
    done = call("navigate", "model=ins", *one, "out=made")
    assert done.code == 0, done.err
    found = pd.read_parquet(tmp_path / "made" / f"drive={drive.row.name}" / "solution.parquet")
    assert apart(found, batch(drive, "ins")) < 1e-5  # 3 km adrift after a minute without a correction
