"""A filter as functions of vectors, which is all that a vehicle needs of it.

    begin(imu, fixes, lever_arm_b) → memory, ready    where a car can be aligned
    read(memory, fix)              → fix in n
    turn(memory, imu, fix in n)    → memory, told     one epoch: ``dlkf.filters.integration.advance``
    row(memory, told)              → row              latitude, longitude, …: a row of ``solution.parquet``
    anchor(memory)                 → memory           the tangent frame follows the car

They call the same code as :class:`dlkf.running.streaming.StreamingFilter`, and nothing in them depends on data but
through tensors, so that ``torch.export`` can take them. All numbers are float64, the first axis is that of drives.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dlkf.data.alignment import ALIGN, align_boundaries
from dlkf.data.drive import Batch, Drive
from dlkf.data.resampling import DEFAULT_STD, SMALLEST_STD, default_std
from dlkf.data.schema import POSITION, STD, VELOCITY
from dlkf.filters.integration import Estimator, Fix, Step, advance
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import TangentFrame, ecef_from_geodetic, ned_axes, tangent_frame
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import NavState
from dlkf.onboard.carried import Layout
from dlkf.running.reanchoring import FrameChange, frame_at, reanchored
from dlkf.running.solution import COLUMNS, solution_columns

FIX = (*POSITION, *VELOCITY, *STD, "quality", "lag_s")  # NaN where a receiver says nothing; all NaN: no fix
FIX_N = 19  # value (6), 1σ (6), used (6), lag
TOLD = {
    "prior": 15,
    "posterior": 15,
    "error": 6,
    "std": 15,
    "innovation": 6,
    "innovation_std": 6,
    "used": 1,
    "speed": 2,
}
_PV = ("pos_n", "pos_e", "pos_d", "vel_n", "vel_e", "vel_d")
ROW = (
    *COLUMNS[1:], "gnss_used", *(f"innovation_{x}" for x in _PV), *(f"innovation_std_{x}" for x in _PV),
    "from_origin_m",
)  # fmt: skip


class Grid(NamedTuple):
    """Samples of an epoch, and seconds of a sample."""

    samples: int
    dt: float

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


def carried_by(estimator: Estimator, grid: Grid) -> Layout:
    """The layout of a filter's memory, from two epochs somewhere."""
    ones = torch.ones(1, 9, dtype=torch.float64)
    frame = tangent_frame(0.8 * ones[0, :1], 0.2 * ones[0, :1], 300 * ones[0, :1])
    state = NavState(0 * ones[:, :3], ones[:, :3], torch.eye(3, dtype=torch.float64)[None])
    imu = ones.new_tensor([0.0, 0.0, -9.81, 0.0, 0.0, 0.0]).expand(1, grid.samples, 6)
    x = begun(estimator, frame, state, ones, ones[:, :3], grid)
    for _ in range(2):
        fix = Fix(torch.cat((x.state.p_n, x.state.v_n), -1), ones[:, :6], ones[:, :6] > 0, 0 * ones[:, 0])
        x, _ = advanced(estimator, x, imu, fix, grid)
    return Layout(x)


def begun(
    estimator: Estimator, frame: TangentFrame, state: NavState, std: Float[Tensor, "B 9"],
    lever_arm_b: Float[Tensor, "B 3"], grid: Grid,
) -> Carried:  # fmt: skip
    """A filter at a known start."""
    B, z = len(std), std.new_zeros
    no = z(B, 1) > 0
    nowhere = NavState(z(B, 1, 3), z(B, 1, 3), z(B, 1, 3, 3))
    batch = Batch(
        imu=z(B, 1, grid.samples, 6), dt=grid.dt, frame=frame, gnss=z(B, 1, 6), gnss_std=z(B, 1, 6),
        gnss_valid=z(B, 1, 6) > 0, gnss_lag=z(B, 1), available=no, lever_arm_b=lever_arm_b, start=state,
        start_std=std, truth=nowhere, truth_valid=no, attitude_valid=no, true_imu_error=z(B, 1, 6), present=~no,
        drive=("",) * B, t_start=z(B),
    )  # fmt: skip
    memory, bias = estimator.begin(batch)
    return Carried(memory, state, ImuError.of(bias), frame, lever_arm_b)


def advanced(estimator: Estimator, x: Carried, imu: Tensor, fix: Fix, grid: Grid) -> tuple[Carried, Step]:
    """One turn of the loop."""
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

    def somewhere(self) -> Float[Tensor, "1 K"]:
        """A memory."""
        return self.layout.pack(self.layout.like)


class Begin(Function):
    """(1, W, M, 6) samples of the epochs that levelling takes, (1, W + 1, 14) fixes at their boundaries,
    (1, 3) → memory at the last boundary, and whether the filter may start from it."""

    @property
    def epochs(self) -> int:
        """W: those that are levelled over, and the one before, whose last samples tell the rate at their beginning."""
        return max(1, round(ALIGN.window_s / self.grid.epoch_s)) + 1

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        shapes = (1, self.epochs, self.grid.samples, 6), (1, self.epochs + 1, len(FIX)), (1, 3)
        return tuple(torch.ones(s, dtype=torch.float64) for s in shapes)

    def forward(self, imu: Tensor, fixes: Tensor, lever_arm_b: Tensor) -> tuple[Tensor, Tensor]:
        """Align as :func:`dlkf.data.alignment.align_boundaries` does, and start there."""
        r_e, v_e, std, known, lag = ecef(fixes[0])
        unknown = torch.full_like(r_e, torch.nan)
        drive = Drive(
            name="", group="", dataset="", t0=0.0, epoch_s=self.grid.epoch_s, rate_hz=1 / self.grid.dt, imu=imu[0],
            gnss_r_e=r_e, gnss_v_e=v_e, gnss_std=std, gnss_valid=known, gnss_lag=lag, quality=fixes[0, :, 12],
            ref_r_e=unknown, ref_v_e=unknown, ref_C_eb=unknown, ref_valid=known[:, 0], ref_imu_error=unknown,
            lever_arm_b=lever_arm_b[0],
        )  # fmt: skip
        found = align_boundaries(drive, ALIGN)
        ok, r_e, v_e, C_eb, std = (x[-1:] for x in (found.ok, found.r_e, found.v_e, found.C_eb, found.std))
        frame = tangent_frame(*geodetic_from_ecef(torch.where(ok.unsqueeze(-1), r_e, 3.7e6)))
        C_ne = frame.C_en.mT
        state = NavState(torch.zeros_like(r_e), (C_ne @ v_e.unsqueeze(-1)).squeeze(-1), C_ne @ C_eb)
        return self.layout.pack(begun(self.estimator, frame, state, std, lever_arm_b, self.grid)), ok.double()


class Read(Function):
    """(1, K), (1, 14) :data:`FIX` → (1, 19) the fix in the tangent frame."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return self.somewhere(), torch.ones(1, len(FIX), dtype=torch.float64)

    def forward(self, memory: Tensor, fix: Tensor) -> Tensor:
        """As :class:`dlkf.running.streaming.StreamingFilter` reads one."""
        frame = self.layout.unpack(memory).frame
        r_e, v_e, std, used, lag = ecef(fix)
        value = torch.cat((frame.from_ecef(r_e), frame.rotate_from_ecef(v_e)), -1)
        return packed_fix(Fix(torch.where(used, value, 0.0), torch.where(used, std, 1.0), used, lag))


class Turn(Function):
    """(1, K), (1, M, 6), (1, 19) → (1, K), (1, sum of :data:`TOLD`)."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        ones = torch.ones(1, self.grid.samples, 6, dtype=torch.float64)
        return self.somewhere(), ones, ones.new_ones(1, FIX_N)

    def forward(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """The loop's turn, and what a :class:`dlkf.filters.integration.Solution` holds of it."""
        given = Fix(fix[:, :6], fix[:, 6:12], fix[:, 12:18] > 0.5, fix[:, 18])
        after, step = advanced(self.estimator, self.layout.unpack(memory), imu, given, self.grid)
        answer, z = step.answer, step.innovation
        used = given.used.any(-1) if answer.accepted is None else given.used.any(-1) & answer.accepted
        innovation_std = torch.full_like(z, torch.nan)
        if (c := answer.covariances) is not None:
            innovation_std = (((c.H @ c.predicted) * c.H).sum(-1) + c.R).clamp_min(0).sqrt()
        std = z.new_full((len(z), 15), torch.nan) if answer.std is None else answer.std
        speed = z.new_full((len(z), 2), torch.nan) if answer.speed is None else answer.speed
        told = (
            *flat(step.prior), *flat(step.posterior), step.complete_error, std, z, innovation_std,
            used.double().unsqueeze(-1), speed,
        )  # fmt: skip
        return self.layout.pack(after), torch.cat([x.double() for x in told], -1)


class Row(Function):
    """(1, K), (1, :data:`TOLD`) → (1, :data:`ROW`)."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return self.somewhere(), torch.ones(1, sum(TOLD.values()), dtype=torch.float64)

    def forward(self, memory: Tensor, told: Tensor) -> Tensor:
        """Geodetic position, velocity and attitude in the axes there, IMU error, all 1σ, innovation."""
        x = self.layout.unpack(memory)
        part = split(told)
        columns = solution_columns(told[:, 0], x.frame, x.state, part["error"], part["std"])
        away = x.state.p_n[:, :2].norm(dim=-1, keepdim=True)
        solution = torch.stack([columns[c] for c in COLUMNS[1:]], -1)
        return torch.cat((solution, part["used"], part["innovation"], part["innovation_std"], away), -1)


class Anchor(Function):
    """(1, K) → (1, K) in a tangent frame whose origin is where the car is."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        return (self.somewhere(),)

    def forward(self, memory: Tensor) -> Tensor:
        """As :class:`dlkf.running.streaming.StreamingFilter` does every 50 km."""
        return self.layout.pack(moved(self.estimator, self.layout.unpack(memory), self.grid))


def moved(estimator: Estimator, x: Carried, grid: Grid, change: FrameChange | None = None) -> Carried:
    """Everything in another tangent frame, by default one whose origin is the present position."""
    change = change or FrameChange(x.frame, frame_at(x.state, x.frame))
    state = change.state(x.state)
    fresh = begun(estimator, change.new, state, state.p_n.new_ones(len(state.p_n), 9), x.lever_arm_b, grid)
    return Carried(reanchored(x.memory, change, fresh.memory), state, x.error, change.new, x.lever_arm_b)


def ecef(fix: Float[Tensor, "B 14"]) -> tuple[Tensor, Tensor, Tensor, Bool[Tensor, "B 6"], Tensor]:
    """ECEF position and velocity of fixes, 1σ, which components are known, lag.

    As :func:`dlkf.data.resampling.fixes_at` has them.
    """
    lat, lon = torch.deg2rad(fix[:, 0]), torch.deg2rad(fix[:, 1])
    r_e, C_en = ecef_from_geodetic(lat, lon, fix[:, 2]), ned_axes(lat, lon)
    quality = fix[:, 12:13]
    std, satellites = fix[:, 6:12], torch.zeros_like(quality) > 0
    for q in DEFAULT_STD:
        std = torch.where(std.isnan() & (quality == q), fix.new_tensor(default_std(q)), std)
        satellites = satellites | (quality == q)
    known = fix[:, 3:6].isfinite()
    v_e = (C_en @ torch.where(known, fix[:, 3:6], 0.0).unsqueeze(-1)).squeeze(-1)
    position = (satellites & fix[:, :3].isfinite().all(-1, keepdim=True)).expand(-1, 3)
    lag = torch.where(position[:, 0], fix[:, 13], 0.0)
    return r_e, v_e, std.clamp_min(SMALLEST_STD), torch.cat((position, position & known), -1), lag


def packed_fix(fix: Fix) -> Float[Tensor, "B 19"]:
    """A fix in n as numbers."""
    lag = fix.value.new_zeros(len(fix.value)) if fix.lag is None else fix.lag
    return torch.cat((fix.value, fix.std, fix.used.double(), lag.unsqueeze(-1)), -1)


def flat(state: NavState) -> tuple[Tensor, Tensor, Tensor]:
    """Position, velocity, attitude by rows."""
    return state.p_n, state.v_n, state.C_nb.flatten(-2)


def split(told: Float[Tensor, "*b told"]) -> dict[str, Tensor]:
    """The parts of :data:`TOLD` by name."""
    return dict(zip(TOLD, told.split(list(TOLD.values()), -1)))
