"""What a vehicle does to a stream: late, lost, bad and endless data, and filters that break or do not fit."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.alignment import AlignConfig
from dlkf.filters.build import build_filter
from dlkf.filters.card import LowSampleRateWarning
from dlkf.running.replay import replay_drive
from dlkf.running.solution import estimates_table
from dlkf.running.streaming import Status, StreamingFilter
from tests.running.streams import ARM, EARTH, IMU, ROUNDING, apart, batch, estimator, network, plus, some, table, until


def test_a_long_wait_for_the_first_fix_costs_no_memory(segment):
    """Nothing for 20 s, then regular fixes: as the batch run, which starts as soon as it has two."""
    tables = some(segment, segment.gnss["t"] > 19.5, "gnss")
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    for _ in replay_drive(stream, until(tables, 19.9).imu, {c: x[:0] for c, x in tables.gnss.items()}):
        assert len(stream._samples._rows) <= 1002
    rest = some(tables, tables.imu["t"] > 19.9, "imu")
    assert apart(table(stream, rest), batch(tables, "mbkf15")) < ROUNDING


def test_bad_packets_are_refused_and_change_nothing(segment):
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM)
    still, turn = (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)
    here = [float(segment.gnss[c][25]) for c in ("lat_deg", "lon_deg", "height_m")]
    reasons, found = [], []
    for receipt in replay_drive(stream, segment.imu, segment.gnss):
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
    for words in ("duplicate", "goes back", "gap", "finite", "no fix", "±90", "std", "late", "ahead"):
        assert any(words in r for r in reasons), words
    assert apart(estimates_table(found), batch(segment, "mbkf15")) < ROUNDING


def test_a_fix_later_than_the_history_is_refused(drive):
    """Fixes from 30 to 35 s come 8 s late, the memory is 4 s: the solution without them."""
    t = drive.gnss["t"]
    tardy = (t > 29.5) & (t < 35.5)
    stream = StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM, history_s=4.0)
    found = table(stream, drive, arrival=t + np.where(tardy, 8.2, 0.0))
    assert stream.counts["refused"] == tardy.sum() == 6
    assert apart(found, batch(some(drive, ~tardy, "gnss"), "mbkf15")) < ROUNDING


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
def test_a_diverged_filter_starts_over(segment, fault):
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
    found = [e.t for r in replay_drive(stream, segment.imu, segment.gnss) for e in r.estimates]
    assert stream.counts["diverged"] == 1 and np.diff(found).max() == 2.0 and found[-1] == 35.0
    assert np.isfinite(stream.latest.row["lat_deg"])


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


def test_a_filter_that_listens_warns_of_samples_too_slow_for_it(segment):
    """As the commands do: of the rate it is given, and of that at which samples come; no other filter does."""
    said = "the filter needs samples at 50 Hz or more for its full accuracy and this stream has 10 Hz"
    with pytest.warns(LowSampleRateWarning, match=said):
        StreamingFilter(plus(), rate_hz=10.0)
    tenth = np.arange(len(segment.imu["t"])) % 10 == 9
    slow = some(segment, tenth, "imu")
    stream = StreamingFilter(plus(), lever_arm_b=ARM)
    with pytest.warns(LowSampleRateWarning, match=said) as heard:
        for _ in replay_drive(stream, slow.imu, slow.gnss):
            pass
    assert len(heard) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        StreamingFilter(plus())
        StreamingFilter(build_filter("mbkf15", IMU), rate_hz=10.0)


def test_without_motion_it_goes_on_aligning(segment):
    stream = StreamingFilter(estimator("ins"), lever_arm_b=ARM, align=AlignConfig(min_speed=1000.0))
    assert not any(r.estimates for r in replay_drive(stream, segment.imu, segment.gnss))
    assert stream.aligning and stream.now() is None and len(stream._samples._rows) < 200
