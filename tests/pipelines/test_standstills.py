"""The study of standstills on cars that are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from pipelines.studies.plus import Case
from pipelines.studies.standstills import count_standstills, format_row

from dlkf.command.simulated import compose_recipe
from tests.drives import drive_in_memory
from tests.filters.test_stationarity import SWAY, shaken


def test_the_seconds_of_a_stop_in_an_outage_are_counted():
    batch = shaken((0.05, 1e-3), (0.5, 2e-2), SWAY)
    case = Case("town", 20, batch, np.full(8, 20), (60,), list(batch.drive))
    rest, found, motion, taken = count_standstills([case])
    assert 8 * 58 < rest <= 8 * 60 and found > 0.9 * rest
    assert motion > 8 * 18 and taken == 0


def test_means_show_a_standstill_that_an_idling_engine_hides():
    drive = drive_in_memory(compose_recipe("simulated@dataset=fleet"), 0, 240)
    standing = drive.ref_v_e[1:].norm(dim=-1) < 0.1
    t = torch.arange(50) / 50
    idling = torch.sin(2 * math.pi * 20 * t)[:, None].expand(-1, 6) * torch.tensor([1.0] * 3 + [0.1] * 3)
    drive = replace(drive, imu=drive.imu + standing[:, None, None] * idling)
    cells = [x.strip() for x in format_row("car", [drive], []).split("|")[1:-1]]
    assert int(cells[1]) > 3 and int(cells[2]) > 60
    assert float(cells[5].rstrip("% ")) < 20 and float(cells[8].rstrip("% ")) > 80
