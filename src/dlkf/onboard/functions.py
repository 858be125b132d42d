"""A filter as functions of vectors: the part of a vehicle's core that differs from filter to filter.

    start(start, lever_arm_b)          → memory        a filter at a known position, velocity and attitude
    turn(memory, imu, fix)             → memory, outputs  one update interval: ``dlkf.filters.integration.advance``
    carry(memory, imu, share, outputs)    → outputs          the state within the next one
    row(memory, outputs)                  → row           latitude, longitude, …: a row of ``solution.parquet``
    anchor(memory)                     → memory        the tangent frame follows the car
    bridge(memory, seconds, outputs)      → memory, outputs  the filter goes on after a gap of the IMU

They call the same code as :class:`dlkf.running.streaming.StreamingFilter`, and nothing in them depends on data but
through tensors, so that they can be recorded. All numbers are float64, the first axis is that of drives.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.data.aid_tables import AidTable
from dlkf.data.aids import ROW as AID_ROW
from dlkf.data.drive import Batch
from dlkf.filters.aids.attach import aid_columns, find_tables, unmeasured_value
from dlkf.filters.integration import Estimator, Fix, Step, advance
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import NOMINAL_GRAVITY, TangentFrame, tangent_frame
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.onboard.carried import Layout
from dlkf.running.bridging import Stretch, bridge, bridge_std
from dlkf.running.reanchoring import FrameChange, frame_at, reanchor
from dlkf.running.solution import COLUMNS, solution_columns

# latitude, longitude [rad], height [m], velocity (3), attitude (9), 1σ of position, velocity, attitude (9), bias of the
# gyroscopes and its 1σ (6), how much more than claimed fixes scatter (2)
START = 32
FIX_N = 19  # value (6), 1σ (6), used (6), lag; then of each further sensor AID_N
AID_N = len(AID_ROW)
OUTPUTS = {
    "prior": 15,
    "posterior": 15,
    "error": 6,
    "std": 15,
    "innovation": 6,
    "innovation_covariance": 36,
    "position_covariance": 4,
    "rejected": 6,
    "used": 1,
}
_PV = ("pos_n", "pos_e", "pos_d", "vel_n", "vel_e", "vel_d")
ROW = (
    *COLUMNS[1:], "gnss_used", *(f"innovation_{x}" for x in _PV), *(f"innovation_std_{x}" for x in _PV),
    "from_origin_m",
)  # fmt: skip


class Grid(NamedTuple):
    """Samples of an epoch, seconds of a sample, and the type that the filter computes in.

    Memories, samples, fixes and rows are float64 in any case. In float32 positions are metres from an origin that is
    never far (:data:`dlkf.onboard.c_source.ANCHOR_M`), and that origin, the axes there and rows stay float64.
    """

    samples: int
    dt: float
    dtype: torch.dtype = torch.float64

    @property
    def epoch_s(self) -> float:
        """Length of an epoch [s]."""
        return self.samples * self.dt


class Carried(NamedTuple):
    """What goes from epoch to epoch."""

    memory: Any
    state: NavState
    error: ImuError
    frame: TangentFrame
    lever_arm_b: Tensor


def make_layout(estimator: Estimator, grid: Grid) -> Layout:
    """The layout of a filter's memory, from two epochs somewhere."""
    ones = torch.ones(1, 9, dtype=grid.dtype)
    frame = tangent_frame(0.8 * ones[0, :1], 0.2 * ones[0, :1], 300 * ones[0, :1], grid.dtype)
    state = NavState(0 * ones[:, :3], ones[:, :3], torch.eye(3, dtype=grid.dtype)[None])
    imu = ones.new_tensor([0.0, 0.0, -NOMINAL_GRAVITY, 0.0, 0.0, 0.0]).expand(1, grid.samples, 6)
    x = begin_filter(estimator, frame, state, ones, ones[:, :3], grid)
    for _ in range(2):
        aids = {table.name: ones[:, :AID_N] for table in find_tables(estimator)}
        fix = Fix(torch.cat((x.state.p_n, x.state.v_n), -1), ones[:, :6], ones[:, :6] > 0, 0 * ones[:, 0], aids)
        x, _ = advance_filter(estimator, x, imu, fix, grid)
    return Layout(x)


def begin_filter(
    estimator: Estimator, frame: TangentFrame, state: NavState, std: Float[Tensor, "B 9"],
    lever_arm_b: Float[Tensor, "B 3"], grid: Grid, gyro: Float[Tensor, "B 6"] | None = None,
    noise: Float[Tensor, "B 2"] | None = None,
) -> Carried:  # fmt: skip
    """A filter at a known start."""
    B, z = len(std), std.new_zeros
    no = z(B, 1) > 0
    nowhere = NavState(z(B, 1, 3), z(B, 1, 3), z(B, 1, 3, 3))
    batch = Batch(
        imu=z(B, 1, grid.samples, 6), dt=grid.dt, frame=frame, gnss=z(B, 1, 6), gnss_std=z(B, 1, 6),
        gnss_valid=z(B, 1, 6) > 0, gnss_lag=z(B, 1), available=no, lever_arm_b=lever_arm_b, start=state,
        start_std=std, truth=nowhere, truth_valid=no, attitude_valid=no, true_imu_error=z(B, 1, 6), present=~no,
        drive=("",) * B, t_start=z(B), start_gyro=gyro, start_noise=noise,
    )  # fmt: skip
    memory, bias = estimator.begin(batch)
    return Carried(memory, state, ImuError.of(bias), frame, lever_arm_b)


def advance_filter(estimator: Estimator, x: Carried, imu: Tensor, fix: Fix, grid: Grid) -> tuple[Carried, Step]:
    """One filter step."""
    memory, step = advance(
        estimator, x.memory, x.state, x.error, imu, fix, dt=grid.dt, frame=x.frame, lever_arm_b=x.lever_arm_b
    )
    return Carried(memory, step.posterior, step.error, x.frame, x.lever_arm_b), step


class Function(nn.Module):
    """One of the functions of a filter; its weights, where the filter has some, are the module's."""

    def __init__(self, estimator: Estimator, grid: Grid, layout: Layout) -> None:
        super().__init__()
        self.grid, self.layout = grid, layout
        if isinstance(estimator, nn.Module):
            self.estimator = estimator
        else:
            object.__setattr__(self, "estimator", estimator)

    def example(self) -> tuple[Tensor, ...]:
        """Arguments of the shapes that the function takes."""
        raise NotImplementedError

    def example_memory(self) -> Float[Tensor, "1 K"]:
        """A memory."""
        return self.layout.pack(self.layout.like)


class Begin(Function):
    """(1, :data:`START`), (1, 3) → (1, K): the filter at a start."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return torch.ones(1, START, dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64)

    def forward(self, start: Tensor, lever_arm_b: Tensor) -> Tensor:
        """Its tangent frame has its origin there."""
        lat, lon, height = start[:, :3].unbind(-1)
        frame = tangent_frame(lat, lon, height, self.grid.dtype)
        start, arm = start.to(self.grid.dtype), lever_arm_b.to(self.grid.dtype)
        v_n, C_nb, std = start[:, 3:6], start[:, 6:15].unflatten(-1, (3, 3)), start[:, 15:24]
        state = NavState(torch.zeros_like(v_n), v_n, C_nb)
        gyro, noise = start[:, 24:30], start[:, 30:]
        return self.layout.pack(begin_filter(self.estimator, frame, state, std, arm, self.grid, gyro, noise))


class Turn(Function):
    """(1, K), (1, M, 6), (1, :func:`count_fix_numbers`) → (1, K), (1, :func:`count_output_numbers`)."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        ones = torch.ones(1, self.grid.samples, 6, dtype=torch.float64)
        return self.example_memory(), ones, ones.new_ones(1, count_fix_numbers(self.estimator))

    def forward(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """The loop's turn, and what a :class:`dlkf.filters.integration.BatchSolution` holds of it."""
        imu, fix = imu.to(self.grid.dtype).mT.contiguous().mT, fix.to(self.grid.dtype)  # samples beside each other
        names = [table.name for table in find_tables(self.estimator)]
        aids = {name: fix[:, FIX_N + AID_N * k : FIX_N + AID_N * (k + 1)] for k, name in enumerate(names)}
        given = Fix(fix[:, :6], fix[:, 6:12], fix[:, 12:18] > 0.5, fix[:, 18], aids or None)
        after, step = advance_filter(self.estimator, self.layout.unpack(memory), imu, given, self.grid)
        answer, z = step.answer, step.innovation
        used = given.used.any(-1) if answer.accepted is None else given.used.any(-1) & answer.accepted
        S, P = z.new_full((len(z), 36), torch.nan), z.new_full((len(z), 4), torch.nan)
        if (c := answer.covariances) is not None:
            S, P = c.innovation.flatten(1), c.predicted[:, :2, :2].flatten(1)
        rejected = torch.zeros_like(z) if answer.rejected is None else answer.rejected
        std = z.new_full((len(z), 15), torch.nan) if answer.std is None else answer.std
        said = z.new_zeros(len(z), 0) if answer.aids is None else answer.aids
        outputs = (
            *flatten_state(step.prior), *flatten_state(step.posterior), step.complete_error, std, z, S, P, rejected,
            used.double().unsqueeze(-1), said,
        )  # fmt: skip
        return self.layout.pack(after), torch.cat([x.double() for x in outputs], -1)


@dataclass(frozen=True)
class _OtherTime:
    """A tangent frame whose second is ``share`` of one: rates are ω s, gravity is g s²."""

    frame: TangentFrame
    share: Tensor

    @property
    def earth_rate_n(self) -> Tensor:
        return self.frame.earth_rate_n * self.share

    def gravity(self, p_n: Tensor) -> Tensor:
        return self.frame.gravity(p_n) * self.share**2


class Carry(Function):
    """(1, K), (1, M, 6), (1, 1), (1, :data:`OUTPUTS`) → (1, :data:`OUTPUTS`): a ``share`` of an interval later.

    The samples are M of equal length over that share. The strapdown takes an interval of full length, in which time
    runs ``share`` as fast: v s, f s², ω s and g s² give the same positions and attitudes.
    """

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        ones = torch.ones(1, self.grid.samples, 6, dtype=torch.float64)
        return self.example_memory(), ones, 0.5 * ones[:, 0, :1], ones.new_ones(1, count_output_numbers(self.estimator))

    def forward(self, memory: Tensor, imu: Tensor, share: Tensor, outputs: Tensor) -> Tensor:
        """What was said of the last epoch, with another posterior."""
        x = self.layout.unpack(memory)
        error, state = ImuError(*_to_double(x.error)), NavState(*_to_double(x.state))
        force, rate = error.correct(imu).split(3, -1)
        s = share.unsqueeze(-1)
        begin, scaled = state._replace(v_n=state.v_n * share), torch.cat((force * s**2, rate * s), -1)
        frame: Any = _OtherTime(x.frame.in_precision(torch.float64), share)
        end = strapdown(begin, scaled, self.grid.dt, frame).end
        first = OUTPUTS["prior"]
        carried = torch.cat(flatten_state(end._replace(v_n=end.v_n / share)), -1)
        return torch.cat((outputs[:, :first], carried, outputs[:, first + OUTPUTS["posterior"] :]), -1)


def _to_double(parts: Iterable[Tensor | None]) -> list[Any]:
    return [None if x is None else x.double() for x in parts]


class Row(Function):
    """(1, K), (1, :data:`OUTPUTS`) → (1, :data:`ROW`), then what is said of further sensors."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return self.example_memory(), torch.ones(1, count_output_numbers(self.estimator), dtype=torch.float64)

    def forward(self, memory: Tensor, outputs: Tensor) -> Tensor:
        """Geodetic position, velocity and attitude in the axes there, IMU error, all 1σ, innovation."""
        x, part = self.layout.unpack(memory), split_outputs(outputs)
        state = NavState(*part["posterior"].split([3, 3, 9], -1))
        state = state._replace(C_nb=state.C_nb.unflatten(-1, (3, 3)))
        columns = solution_columns(outputs[:, 0], x.frame, state, part["error"], part["std"])
        away = state.p_n[:, :2].norm(dim=-1, keepdim=True)
        solution = torch.stack([columns[c] for c in COLUMNS[1:]], -1)
        variance, rejected = part["innovation_covariance"][:, ::7], part["rejected"]
        innovation_std = torch.where(rejected > 0, rejected, variance).clamp_min(0).sqrt()
        return torch.cat((solution, part["used"], part["innovation"], innovation_std, away, part["aids"]), -1)


class Anchor(Function):
    """(1, K) → (1, K) in a tangent frame whose origin is where the car is."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return (self.example_memory(),)

    def forward(self, memory: Tensor) -> Tensor:
        """As :class:`dlkf.running.streaming.StreamingFilter` does every 50 km."""
        return self.layout.pack(move_anchor(self.estimator, self.layout.unpack(memory), self.grid))


def move_anchor(estimator: Estimator, x: Carried, grid: Grid, change: FrameChange | None = None) -> Carried:
    """Everything in another tangent frame, by default one whose origin is the present position."""
    change = change or FrameChange(x.frame, frame_at(x.state, x.frame))
    state = change.state(x.state)
    change = FrameChange(change.old, change.new.in_precision(grid.dtype))
    fresh = begin_filter(estimator, change.new, state, state.p_n.new_ones(len(state.p_n), 9), x.lever_arm_b, grid)
    return Carried(reanchor(x.memory, change, fresh.memory), state, x.error, change.new, x.lever_arm_b)


class Bridge(Function):
    """(1, K), (1, 3), (1, :data:`OUTPUTS`) → (1, K), (1, :data:`OUTPUTS`): after a stretch with a gap of the IMU.

    The outputs are those of :class:`Carry` over the stretch, the seconds those before, in and after the gap.
    """

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        ones = torch.ones(1, count_output_numbers(self.estimator), dtype=torch.float64)
        return self.example_memory(), ones[:, :3], ones

    def forward(self, memory: Tensor, seconds: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """As :class:`dlkf.running.epoch_filter.EpochFilter` does."""
        x, part = self.layout.unpack(memory), split_outputs(outputs)
        p_n, v_n, C_nb = part["posterior"].split([3, 3, 9], -1)
        end = NavState(p_n, v_n, C_nb.unflatten(-1, (3, 3)))
        after = cross_gap(self.estimator, x, end, seconds, self.grid)
        std = bridge_std(part["std"], x.memory, after.memory)
        none = {"innovation", "rejected", "used"}
        part |= {name: torch.zeros_like(part[name]) for name in none} | {"prior": part["posterior"], "std": std}
        of_nothing = [unmeasured_value(column) for column in aid_columns(self.estimator)]
        if of_nothing:
            stays = torch.tensor([value is None for value in of_nothing])
            part["aids"] = torch.where(stays, part["aids"], outputs.new_tensor([value or 0.0 for value in of_nothing]))
        return self.layout.pack(after), torch.cat([part[name].double() for name in (*OUTPUTS, "aids")], -1)


def cross_gap(estimator: Estimator, x: Carried, end: NavState, seconds: Tensor, grid: Grid) -> Carried:
    """Everything at the ``end`` of a stretch with a gap (:class:`dlkf.running.bridging.Stretch`)."""
    end, begin = NavState(*(e.to(b) for e, b in zip(end, x.state))), x.state
    fresh = begin_filter(estimator, x.frame, end, end.p_n.new_ones(len(end.p_n), 9), x.lever_arm_b, grid)
    stretch = Stretch(begin, end, seconds.to(end.p_n), x.frame)
    return x._replace(memory=bridge(x.memory, stretch, fresh.memory), state=end)


def count_fix_numbers(estimator: Any) -> int:
    """How many numbers a turn takes beside the samples: those of a fix, then of each further sensor."""
    return FIX_N + AID_N * len(find_tables(estimator))


def pack_fix(fix: Fix, aids: Sequence[AidTable] = ()) -> Float[Tensor, "B f"]:
    """A fix in n, and what ``aids`` said, as numbers."""
    value = fix.value
    lag = value.new_zeros(len(value)) if fix.lag is None else fix.lag
    said = fix.aids or {}
    others = [said[a.name].to(value) if a.name in said else value.new_zeros(len(value), AID_N) for a in aids]
    return torch.cat((value, fix.std, fix.used.double(), lag.unsqueeze(-1), *others), -1)


def flatten_state(state: NavState) -> tuple[Tensor, Tensor, Tensor]:
    """Position, velocity, attitude by rows."""
    return state.p_n, state.v_n, state.C_nb.flatten(-2)


def count_output_numbers(estimator: Any) -> int:
    """How many numbers a turn gives beside the memory: :data:`OUTPUTS`, then what is said of further sensors."""
    return sum(OUTPUTS.values()) + len(aid_columns(estimator))


def split_outputs(outputs: Float[Tensor, "*b outputs"]) -> dict[str, Tensor]:
    """The parts of :data:`OUTPUTS` by name, and ``aids``, which may be empty."""
    last = outputs.shape[-1] - sum(OUTPUTS.values())
    return dict(zip((*OUTPUTS, "aids"), outputs.split([*OUTPUTS.values(), last], -1)))
