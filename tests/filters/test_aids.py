"""Wheel speed, heading and barometer as sources: Jacobians by differences, what they find, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.data.aid_tables import STANDARD, AidTable
from dlkf.data.aids import ROW, aid_rows, pressure_height
from dlkf.data.resampling import SampleGrid
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.filters.aids.attach import SENSORS, aid_columns, describe_aids, find_tables, with_aids
from dlkf.filters.aids.stretch import stretch_weights
from dlkf.filters.aids.trust import PATIENCE, PROBATION, Trust, judge
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Epoch, Fix, integrate
from dlkf.filters.sources import Predicted
from dlkf.filters.tuning import Tuning
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import PVA, ErrorStates
from dlkf.navigation.strapdown import strapdown
from dlkf.running.start import align_each
from tests.cars import IMU, car_batch, write_cars
from tests.turned import turn_frames

WHEEL = {"scale": 1.03, "delay_s": 0.15, "right_m": 0.6}


def test_samples_become_one_row_for_each_interval():
    grid = SampleGrid(10.0, 1.0, 3, 4)
    t = np.array([9.9, 10.2, 10.4, 10.6, 10.8, 12.7, 13.5])
    columns = {"t": t, "speed": np.array([1.0, 2.0, 4.0, np.nan, 6.0, 7.0, 8.0]), "std": np.full(7, 0.2)}
    mean = dict(zip(ROW, aid_rows(STANDARD["speed"], columns, grid).T))
    assert np.allclose(mean["count"], [0, 3, 0, 1]) and np.allclose(mean["value"], [0, 4, 0, 7])
    assert np.allclose(mean["lag_s"], [0, 1 - (0.2 + 0.4 + 0.8) / 3, 0, 0.3]) and np.allclose(
        mean["std"], [0, 0.2, 0, 0.2]
    )
    assert np.allclose(mean["span_s"], [0, 0.6 * 3 / 2, 0, 0])  # three samples 0.6 s apart cover 0.9 s
    last = dict(zip(ROW, aid_rows(AidTable("x", "speed", "last"), columns, grid).T))
    assert np.allclose(last["value"], [0, 6, 0, 7]) and np.allclose(last["lag_s"], [0, 0.2, 0, 0.3])
    unknown = aid_rows(STANDARD["speed"], {**columns, "std": np.full(7, np.nan)}, grid)
    assert not unknown[:, 1].any()


def test_pressure_gives_the_height_of_the_standard_atmosphere():
    assert np.allclose(pressure_height(np.array([101325.0, 89874.6, 54019.9])), [0, 1000, 5000], atol=5)


def test_the_mean_of_a_line_over_a_stretch_is_its_value_in_the_middle():
    lag, span = torch.tensor([0.5, 0.3, 0.02, 0.43]).double(), torch.tensor([1.0, 0.5, 0.0, 0.0]).double()
    weights = stretch_weights(lag, span, 50, 0.02)
    age = 0.02 * torch.arange(50, -1, -1).double()
    assert torch.allclose(weights.sum(-1), torch.ones(4).double())
    assert torch.allclose((weights * age).sum(-1), lag, atol=1e-12)


@pytest.fixture(scope="module")
def segments():
    return car_batch(3, 4)


def _epoch(batch, start, error, row):
    fix = Fix(batch.gnss[:, 0], batch.gnss_std[:, 0], batch.gnss_valid[:, 0], None, row)
    corrected = error.correct(batch.imu[:, 0])
    window = strapdown(start, corrected, batch.dt, batch.frame)
    rate = corrected[:, -2:, 3:].mean(1)
    z = torch.zeros_like(fix.value)
    return Epoch(
        batch.imu[:, 0], corrected, error, start, window, window.end, rate, rate, z, fix, None, batch.dt, batch.frame
    )


@pytest.mark.parametrize("name", SENSORS)
def test_h_is_the_derivative_of_what_is_predicted(segments, name):
    """By differences: an error at the start of the interval is carried to its end, to which H refers."""
    kind = SENSORS[name]
    states = ErrorStates("scale", structure=True, others=tuple(kind.parameters))
    source = kind(IMU, Tuning(), states)
    rows = {"speed": [14.0, 0.0, 0.4, 0.5, 8.0], "heading": [0.3, 0, 0.2, 0, 1], "baro": [320.0, 0, 0.4, 0.5, 5]}
    said = {name: torch.tensor([rows[name]] * 3, dtype=torch.float64)}
    at = {n: torch.full((3,), x, dtype=torch.float64) for n, x in zip(kind.parameters, (0.02, 0.08, 0.4, 0.1))}
    prediction = Predicted(torch.eye(states.count, dtype=torch.float64).expand(3, -1, -1), parameters=at)
    memory = source.begin(segments)
    zero = ImuError(torch.zeros(3, 6).double())
    here = _epoch(segments, segments.start, zero, said)
    found, _ = source.rows(here, memory, prediction)
    torch.manual_seed(0)
    size = torch.tensor([1.0] * 3 + [0.1] * 3 + [1e-3] * 3).double()
    for _ in range(4):
        delta = size * torch.randn(3, 9).double()
        bias = torch.tensor([1e-2] * 3 + [1e-4] * 3).double() * torch.randn(3, 6).double()
        there = _epoch(segments, segments.start.correct(delta), ImuError(bias), said)
        moved, _ = source.rows(there, memory, prediction)
        dx = torch.zeros(3, states.count).double()
        dx[:, PVA] = here.window.end.error_to(there.window.end)
        dx[:, 9:15] = bias
        linear = (found.H @ dx.unsqueeze(-1)).squeeze(-1)
        change = found.z - moved.z
        assert torch.allclose(change, linear, atol=2e-3, rtol=2e-2)
    for n, step in zip(kind.parameters, (1e-3, 1e-3, 1e-2, 1e-2)):
        moved, _ = source.rows(here, memory, prediction._replace(parameters={**at, n: at[n] + step}))
        slope = (found.z - moved.z) / step
        assert torch.allclose(slope, found.H[..., states.of(n)].squeeze(-1), atol=5e-2, rtol=1e-2)


@pytest.fixture(scope="module")
def aided(tmp_path_factory):
    """Three minutes of the exact car with a wheel, heading and barometer, as a batch of its own alignment."""
    folder = write_cars(tmp_path_factory.mktemp("data") / "aided", 1, aids=WHEEL, seconds=180.0)
    drives = load_dataset(folder, dtype=torch.float64)
    return whole_drives(drives, align_each(drives))


def test_scale_delay_and_place_of_a_wheel_are_found(aided):
    model = with_aids(build_filter("mbkf21_car", IMU), [STANDARD["speed"]])
    said = dict(zip(aid_columns(model), integrate(aided, model).aids[0].T))
    assert said["speed_used"][2:-2].all()
    for name, true, within in (
        ("wheel_scale", 0.03, 0.003),
        ("wheel_delay_s", 0.15, 0.03),
        ("wheel_right_m", 0.6, 0.1),
    ):
        assert abs(said[name][-1] - true) < within, name
        assert abs(said[name][-1] - true) < 4 * said[f"std_{name}"][-1]


def test_all_three_agree_with_the_car(aided):
    model = with_aids(build_filter("mbkf21_car", IMU), STANDARD.values())
    assert [table.name for table in find_tables(model)] == list(STANDARD)
    said = dict(zip(aid_columns(model), integrate(aided, model).aids[0].T))
    for name in STANDARD:
        seen = said[f"{name}_innovation"].isfinite()
        assert said[f"{name}_used"][seen][3:].all() and seen.sum() > 170
    assert abs(said["baro_offset_m"][-1] - 30) < 0.5 and abs(said["heading_offset"][-1]) < 0.005


def _estimates(aided, name: str, change):
    """What a filter says of a sensor whose rows (B, T, 5) are changed: by column, over time."""
    model = with_aids(build_filter("mbkf21_car", IMU), [STANDARD[name]])
    rows = aided.aids[name].clone()
    rows[..., 0] = torch.where(rows[..., 4] > 0, change(rows[..., 0]), 0.0)
    changed = replace(aided, aids={**aided.aids, name: rows})
    return dict(zip(aid_columns(model), integrate(changed, model).aids[0].T))


def test_the_offset_of_a_displayed_speed_is_found(aided):
    said = _estimates(aided, "speed", lambda v: v + 0.5 * torch.sign(v))
    assert abs(said["wheel_offset"][-1] - 0.5) < 0.1 and said["speed_used"][10:-2].all()
    assert abs(said["wheel_scale"][-1] - 0.03) < 0.01


def test_a_barometer_feels_the_speed(aided):
    v = aided.truth.v_n[..., :2].square().sum(-1)
    said = _estimates(aided, "baro", lambda h: h + 0.2 * v / (2 * 9.81))
    assert abs(said["baro_wind"][-1] - 0.2) < 0.04 and abs(said["baro_offset_m"][-1] - 30) < 1
    assert abs(_estimates(aided, "baro", lambda h: h)["baro_wind"][-1]) < 0.04


def test_a_heading_that_scatters_more_than_it_says_gets_a_larger_sigma(aided):
    noise = math.radians(3) * torch.randn(aided.size[:2], generator=torch.Generator().manual_seed(0)).double()
    said = _estimates(aided, "heading", lambda y: y + noise)
    late = said["heading_innovation"].isfinite() & (torch.arange(len(noise[0])) > 60)
    assert said["heading_used"][late].double().mean() > 0.95
    assert 2 < math.degrees(said["heading_innovation_std"][late].median()) < 5
    off = _estimates(aided, "heading", lambda y: y + math.radians(25))  # no noise, but mounted otherwise
    assert not off["heading_used"].any()


def test_a_wheel_that_reads_zero_below_some_speed_is_no_proof_of_a_standstill(segments):
    """Nor is it used where the car is faster than that."""
    kind = SENSORS["speed"]
    states = ErrorStates("scale", structure=True, others=tuple(kind.parameters))
    source = kind(IMU, Tuning(), states)
    at = {n: torch.zeros(3).double() for n in kind.parameters}
    prediction = Predicted(1e-4 * torch.eye(states.count).double().expand(3, -1, -1), parameters=at)
    said = {"speed": torch.tensor([[0.0, 0.0, 0.5, 0.5, 8.0]] * 3).double()}

    def reads_zero(speed: float, memory):
        v_n = speed * segments.start.C_nb[..., 0]
        start = segments.start._replace(v_n=v_n)
        rest = replace(segments, imu=segments.imu * 0 + still_samples(start).unsqueeze(1).unsqueeze(1))
        (row, after) = source.rows(_epoch(rest, start, ImuError(torch.zeros(3, 6).double()), said), memory, prediction)
        return row, after

    fresh = source.begin(segments)
    row, after = reads_zero(0.02, fresh)
    assert row.used.all() and after.stopped.all() and (after.zone < 0.1).all()
    row, creeping = reads_zero(0.9, fresh)
    assert not row.used.any() and not creeping.stopped.any() and (creeping.zone > 0.7).all()
    row, after = reads_zero(0.3, creeping)
    assert row.used.all() and not after.stopped.any() and (row.R > 0.49).all()


def still_samples(start):
    """Specific force and rates (B, 6) of a car that does not accelerate."""
    up = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    force = (start.C_nb.mT @ up.unsqueeze(-1)).squeeze(-1)
    return torch.cat((force, torch.zeros_like(force)), -1)


def test_a_heading_turns_with_the_frame(aided):
    """The same innovations in frames turned by other angles, the convergence of the meridians with them."""
    model = with_aids(build_filter("mbkf15_nhc", IMU), [STANDARD["heading"]])
    here = torch.arange(aided.size[1])[:, None] != 20  # an interval without a heading
    aided = replace(aided, aids={name: rows * here for name, rows in aided.aids.items()})
    plain = integrate(aided, model).aids[0]
    some = plain[:, 2] > 0
    convergence = aided.truth.p_n[0, :, 1] * torch.tan(torch.asin(-aided.frame.axis_n[0, 2])) / aided.frame.radius[0]
    assert some.sum() > 170 and convergence.abs().max() > 1e-5
    for seed in range(3):
        turned = turn_frames(aided, torch.Generator().manual_seed(seed))
        assert not turned.aids["heading"][0, 20].any()
        assert torch.equal(turned.aids["heading"][..., 1:], aided.aids["heading"][..., 1:])
        assert torch.equal(turned.aids["speed"], aided.aids["speed"])
        said = integrate(turned, model).aids[0]
        assert torch.equal(said[:, 2], plain[:, 2])
        assert torch.allclose(said[some, 0], plain[some, 0], atol=1e-8)  # rad; rounding of 180 updates


def test_a_filter_with_sensors_that_say_nothing_is_the_filter_without(cars):
    plain = build_filter("mbkf21_car", IMU)
    model = with_aids(plain, STANDARD.values())
    none = {name: torch.zeros(*cars.size[:2], len(ROW)).double() for name in STANDARD}
    silent, without = integrate(replace(cars, aids=none), model), integrate(cars, plain)
    assert torch.allclose(silent.posterior.p_n, without.posterior.p_n, atol=1e-9)
    assert torch.equal(integrate(replace(cars, aids=none), plain).posterior.p_n, without.posterior.p_n)
    assert without.aids is None and not silent.aids[..., 2].any()


def test_only_filters_that_know_a_car_take_what_a_drive_has():
    speed = [STANDARD["speed"]]
    assert with_aids(build_filter("mbkf15", IMU), speed) == build_filter("mbkf15", IMU)
    named = build_filter("mbkf15+speed", IMU)
    assert [t.name for t in find_tables(named)] == ["speed"] and named.states.count == 19
    both = build_filter("mbkf21_nhc+speed", IMU)
    assert with_aids(both, speed) is both
    assert both == with_aids(build_filter("mbkf21_nhc", IMU), speed)


def test_a_sensor_of_a_dataset_says_who_takes_it():
    """A filter that may take it and one that never does are not the same."""
    names, speed = ("mbkf21_nhc", "mbkf15", "ins"), STANDARD["speed"]
    models = {name: with_aids(build_filter(name, IMU), [speed]) for name in names}
    (line,) = describe_aids(models, [speed])
    assert line == "speed: used by mbkf21_nhc; mbkf15 takes it as mbkf15+speed; not by ins"


def test_states_have_names():
    states = ErrorStates("scale", structure=True, others=("a", "b"))
    assert states.of("rear_axle") == slice(23, 24) and states.of("b") == slice(27, 28) and states.count == 28
    with pytest.raises(KeyError, match="no state 'c'"):
        states.of("c")
    with pytest.raises(ValueError, match="twice"):
        ErrorStates(others=("a", "a"))


def test_a_sensor_that_contradicts_is_doubted_until_it_agrees_with_a_filter_that_knows():
    trust, yes = Trust.begin(torch.zeros(1), 1), torch.tensor([True])

    def says(z: float, knows: bool) -> bool:
        nonlocal trust
        trust, used, _ = judge(trust, yes, torch.tensor([z]), torch.ones(1), torch.tensor([knows]), yes)
        return bool(used)

    assert says(1.0, False) and not says(9.0, False) and says(1.0, False)  # a slip is over when it is over
    assert not any(says(9.0, False) for _ in range(int(PATIENCE)))
    assert not any(says(1.0, False) for _ in range(50))  # in an outage anything agrees in the end
    assert [says(1.0, True) for _ in range(int(PROBATION) + 1)] == [False] * (int(PROBATION) - 1) + [True, True]
