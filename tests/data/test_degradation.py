"""Paper eqs 12 and 13: noise on fixes has the size it says, belongs to the drive, and is told to the filters."""

from __future__ import annotations

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.masks import GnssNoise
from dlkf.data.store import load_dataset
from tests.cars import write_cars


def test_noise_is_white_of_its_size_and_in_the_stds(tmp_path):
    (drive,) = load_dataset(write_cars(tmp_path / "town", 1, seconds=300.0), dtype=torch.float64)
    noisy = GnssNoise(2.0, 0.5).add_noise(drive, seed=3)
    seen = drive.gnss_valid.all(-1)
    moved = torch.cat((noisy.gnss_r_e - drive.gnss_r_e, noisy.gnss_v_e - drive.gnss_v_e), -1)[seen]
    # 300 fixes × 3 axes: the standard error of a std is 1/√1800 of it; five of them
    assert moved[:, :3].std() == pytest.approx(2.0, rel=0.12) and moved[:, 3:].std() == pytest.approx(0.5, rel=0.12)
    step = moved[1:] * moved[:-1]
    assert (step.mean(0).abs() < 5 * step.std(0) / len(step) ** 0.5).all()
    assert torch.allclose(noisy.gnss_std[:, :3] ** 2, drive.gnss_std[:, :3] ** 2 + 4.0)
    again, other = (GnssNoise(2.0, 0.5).add_noise(drive, seed=s) for s in (3, 4))
    assert torch.equal(again.gnss_r_e[seen], noisy.gnss_r_e[seen]) and not torch.equal(other.gnss_r_e, noisy.gnss_r_e)


def test_negative_noise_makes_no_sense():
    with pytest.raises(InputError, match="s_p"):
        GnssNoise(-1.0, 0.0)
