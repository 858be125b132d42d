"""The table of further sensors says what the filters said themselves."""

from __future__ import annotations

import re
from dataclasses import replace

import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.evaluation.sensors import sensor_table
from dlkf.filters.aids.attach import aid_columns, with_aids
from dlkf.filters.build import build_filter
from tests.cars import IMU, car_batch
from tests.evaluation.scoring import score


def test_a_row_for_each_filter_and_sensor():
    batch = car_batch(2, 30)
    forward = (batch.truth.C_nb[..., 0] * batch.truth.v_n).sum(-1)
    zero = torch.zeros_like(forward)
    count = zero + 1
    count[:, 10:15] = 0  # nothing for five seconds, then five of nonsense
    value = torch.where((torch.arange(30) >= 15) & (torch.arange(30) < 20), 5 * forward, 1.02 * forward)
    batch = replace(batch, aids={"speed": torch.stack((value, zero, zero, zero, count), -1)})
    plain = build_filter("mbkf21_car", IMU)
    filters = {"plain": plain, "aided": with_aids(plain, [STANDARD["speed"]])}
    columns = {name: aid_columns(model) for name, model in filters.items()}
    scores = score(filters, [batch])
    table = sensor_table(scores, columns)
    assert table is not None and len(table.rows) == 1
    name, sensor, updates, used, spread, found = table.rows[0]
    assert (name, sensor, updates, used) == ("aided", "speed", "50", "80.0") and 0.05 < float(spread) < 1.5
    scale = re.match(r"wheel_scale (\S+) ± (\S+), wheel_delay_s ", found)
    last = scores.filters["aided"].aids[:, -1, columns["aided"].index("wheel_scale")]
    assert scale and abs(float(scale[1]) - last.mean()) < 1e-4
    assert sensor_table(score({"plain": plain}, [batch]), columns) is None


def test_speed_from_vibration_has_a_row_of_its_own_beside_a_wheel_sensor():
    batch = car_batch(2, 30)
    forward = (batch.truth.C_nb[..., 0] * batch.truth.v_n).sum(-1)
    zero = torch.zeros_like(forward)
    batch = replace(batch, aids={"speed": torch.stack((forward, zero, zero, zero, zero + 1), -1)})
    model = with_aids(build_filter("mbkf21_car+vibration_speed", IMU), [STANDARD["speed"]])
    table = sensor_table(score({"both": model}, [batch]), {"both": aid_columns(model)})
    assert table is not None
    speed, vibration = table.rows
    assert speed[1] == "speed" and "wheel_scale" in speed[-1] and "vibration" not in speed[-1]
    assert vibration[:2] == ["both", "vibration_speed"] and vibration[-1] == "–"  # this car does not shake
