"""IMUs and receivers made worse than any preset: what is added has the size that was drawn."""

from dataclasses import replace

import torch

from dlkf.data.augmentation import SensorDegradation, degrade_sensors, draw_correlated_noise

from .scene import RATE, scene

QUIET = SensorDegradation(share=0.0, shaken=0.0, rectified=0.0, gnss=0.0)


def test_nothing_drawn_is_nothing_changed():
    batch = scene(2, 10)
    after = degrade_sensors(batch, QUIET, torch.Generator().manual_seed(0))
    assert torch.equal(after.imu, batch.imu) and torch.equal(after.gnss, batch.gnss)


def test_white_noise_has_the_density_asked_for():
    batch = scene(4, 40)
    rough = replace(QUIET, share=1.0, accel_noise=(0.02, 0.02), gyro_noise=(1e-3, 1e-3), uneven=0.0,
                    accel_wander=(1e-9, 1e-9), gyro_wander=(1e-9, 1e-9))  # fmt: skip
    added = (degrade_sensors(batch, rough, torch.Generator().manual_seed(0)).imu - batch.imu).flatten(1, 2)
    density = added.std(1).mean(0) / RATE**0.5
    assert torch.allclose(density.double(), torch.tensor([0.02] * 3 + [1e-3] * 3, dtype=torch.float64), rtol=0.05)


def test_a_wandering_error_forgets_in_its_correlation_time():
    g = torch.Generator().manual_seed(0)
    x = draw_correlated_noise(torch.randn(400, 60, 2, generator=g), torch.full((400, 1), torch.e ** (-1 / 10)))
    assert abs(float(x.var()) - 1) < 0.1
    assert abs(float((x[:, 20] * x[:, 30]).mean()) - torch.e**-1) < 0.1


def test_the_car_s_own_motion_is_left_when_it_is_shaken_less():
    batch = scene(3, 20)
    after = degrade_sensors(batch, replace(QUIET, shaken=1.0), torch.Generator().manual_seed(0))
    assert not torch.equal(after.imu, batch.imu)
    assert (after.imu - batch.imu).mean((1, 2)).abs().max() < 1e-3  # m/s²: slow parts and means are kept


def test_a_receiver_is_wrong_by_about_what_it_says():
    batch = scene(60, 40)
    rough = replace(QUIET, gnss=1.0, position=(1.0, 1.0), velocity=(0.1, 0.1))
    after = degrade_sensors(batch, rough, torch.Generator().manual_seed(0))
    off = (after.gnss - batch.gnss).square().mean((0, 1)).sqrt()
    assert torch.allclose(off[:3], torch.ones(3, dtype=off.dtype), atol=0.15) and float(off[3:].max()) < 0.11
    ratio = (after.gnss_std[:, 0, 0].log()).median()
    assert abs(float(ratio)) < 0.25


def test_vibration_makes_an_error_of_the_axis_that_feels_it():
    """A pitch axis that shakes ten times as much errs ten times as much; without vibration nothing errs."""
    batch = scene(30, 40)
    g = torch.Generator().manual_seed(1)
    shake = torch.randn(batch.imu.shape, generator=g, dtype=batch.imu.dtype) * torch.tensor([0.0] * 4 + [0.1, 0.01])
    rough = replace(QUIET, rectified=1.0, gyro_rectified=(0.02, 0.02))
    shaken = replace(batch, imu=batch.imu + shake)
    added = (degrade_sensors(shaken, rough, torch.Generator().manual_seed(0)).imu - shaken.imu)[..., 4:].mean(2)
    size = added.square().mean(1).sqrt().log().mean(0)  # of each car the axis' own share, e^(normal)
    assert abs(float(size[0] - size[1]) - 2.3) < 0.5
    assert abs(float(size[0]) - torch.tensor(0.02 * 0.1).log()) < 0.5
