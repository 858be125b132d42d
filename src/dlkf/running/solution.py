"""``solution.parquet``: what ``navigate`` writes, and the way there from the filter's tangent frame.

One row per epoch. ``t`` [s] is the drive's own clock; position is geodetic (WGS-84), velocity and attitude
are in true local NED at the vehicle; ``accel_error``, ``gyro_error`` [m/s², rad/s] are what the filter takes
off the IMU, body axes; ``std_*`` are 1σ: ``std_pos_n|e|d`` [m], ``std_vel_n|e|d`` [m/s],
``std_roll|pitch|yaw`` [rad], and of the IMU errors. ``gnss_used``: a fix corrected this row. NaN where the
filter has no value. Further sensors add ``<name>_innovation``, its 1σ ``<name>_innovation_std`` and
``<name>_used`` (1 or 0), and what the filter estimates of them with its 1σ, such as ``wheel_scale`` and
``std_wheel_scale``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data import schema
from dlkf.navigation.attitude import rotation_from_rpy, rpy_from_rotation
from dlkf.navigation.earth import TangentFrame, ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, POSITION, VELOCITY, NavState

STD_COLUMNS = (*schema.STD, *(f"std_{c}" for c in (*schema.ATTITUDE, *schema.IMU_ERROR)))
COLUMNS = ("t", *schema.POSITION, *schema.VELOCITY, *schema.ATTITUDE, *schema.IMU_ERROR, *STD_COLUMNS)
GEOMETRY = {  # geoparquet.org, version 1.1; without a crs it is longitude and latitude on WGS 84 (OGC:CRS84)
    "version": "1.1.0",
    "primary_column": "geometry",
    "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Point Z"]}},
}
SCHEMA = pa.schema([pa.field(c, pa.float64()) for c in COLUMNS] + [pa.field("gnss_used", pa.bool_())])
GEO_SCHEMA = SCHEMA.append(pa.field("geometry", pa.binary())).with_metadata({"geo": json.dumps(GEOMETRY)})


def solution_table(
    t: Float[Tensor, " T"],
    frame: TangentFrame,
    state: NavState,
    imu_error: Float[Tensor, "T 6"],
    std: Float[Tensor, "T 15"] | None,
    used: Bool[Tensor, " T"],
) -> pd.DataFrame:
    """Rows of ``solution.parquet`` from one drive's states (T, …) in its tangent frame (one element)."""
    columns = solution_columns(t, frame, state, imu_error, std)
    return pd.DataFrame({k: v.numpy() for k, v in columns.items()} | {"gnss_used": used.cpu().numpy()})


def solution_columns(
    t: Float[Tensor, " T"],
    frame: TangentFrame,
    state: NavState,
    imu_error: Float[Tensor, "T 6"],
    std: Float[Tensor, "T 15"] | None,
) -> dict[str, Float[Tensor, " T"]]:
    """The columns of ``solution.parquet`` without ``gnss_used``, float64.

    C_lb = C_elᵀ C_en C_nb with C_el at the estimated position. The 1σ of vectors turn with the axes as
    uncorrelated errors do, σ'² = (C∘C) σ²; those of roll, pitch and yaw follow by (J⁻¹∘J⁻¹) σ² from
    δh = J δ(roll, pitch, yaw), J = [Rz Ry e₁, Rz e₂, e₃].
    """
    state = NavState(*(x.detach().cpu().double() for x in state))
    C_en = frame.C_en.cpu().double()  # of one frame for all rows, or of one each
    r_e = (C_en @ state.p_n.unsqueeze(-1)).squeeze(-1) + frame.origin_e.cpu()
    lat, lon, height = geodetic_from_ecef(r_e)
    C_ln = ned_axes(lat, lon).mT @ C_en
    rpy = rpy_from_rotation(C_ln @ state.C_nb)
    velocity = torch.einsum("tij,tj->ti", C_ln, state.v_n)
    error, std = imu_error.detach().cpu().double(), _std_columns(std, C_ln, rpy)
    values = (x for part in (velocity, rpy, error, std) for x in part.unbind(-1))
    return dict(zip(COLUMNS, (t.double(), torch.rad2deg(lat), torch.rad2deg(lon), height, *values)))


def _std_columns(std: Tensor | None, C_ln: Tensor, rpy: Tensor) -> Tensor:
    if std is None:
        return torch.full((len(rpy), 15), torch.nan, dtype=torch.float64)
    variance = std.detach().cpu().double() ** 2

    def turned(C: Tensor, part: slice) -> Tensor:
        return torch.einsum("tij,tj->ti", C * C, variance[:, part])

    zero = torch.zeros_like(rpy[:, 0])
    heading = rotation_from_rpy(torch.stack((zero, zero, rpy[:, 2]), -1))
    tilted = rotation_from_rpy(torch.stack((zero, rpy[:, 1], rpy[:, 2]), -1))
    down = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(rpy)
    J = torch.stack((tilted[..., 0], heading[..., 1], down), -1)
    to_rpy = torch.linalg.inv_ex(J)[0] @ C_ln
    parts = (turned(C_ln, POSITION), turned(C_ln, VELOCITY), turned(to_rpy, ATTITUDE))
    return torch.cat((*parts, variance[:, ACCEL], variance[:, GYRO]), -1).sqrt()


@dataclass(frozen=True)
class Estimate:
    """State of the IMU at ``t`` [s, clock of the samples]; tensors have one batch element.

    ``imu_error`` (1, 6) [m/s², rad/s] is what comes off the samples from ``t`` on, ``std`` (1, 15) the 1σ of
    position, velocity, attitude in n and of the IMU error, None where the filter has none. ``gnss_used``: a fix
    corrected this estimate.
    """

    t: float
    frame: TangentFrame
    state: NavState
    imu_error: Tensor
    std: Tensor | None
    gnss_used: bool
    aids: Mapping[str, float] | None = None  # of further sensors, see dlkf.filters.aids.attach.aid_columns

    @cached_property
    def row(self) -> dict[str, float | bool]:
        """The row of ``solution.parquet``: geodetic position, NED, roll-pitch-yaw."""
        t = torch.tensor([self.t], dtype=torch.float64)
        columns = solution_columns(t, self.frame, self.state, self.imu_error, self.std)
        row = {name: float(value) for name, value in columns.items()}
        return row | {"gnss_used": self.gnss_used, **(self.aids or {})}


def estimates_table(estimates: Iterable[Estimate]) -> pd.DataFrame:
    """Estimates as the rows of ``solution.parquet``."""
    parts = []
    for _, group in groupby(estimates, key=lambda e: id(e.frame)):
        rows = list(group)
        state = NavState(*(torch.cat(x) for x in zip(*(e.state for e in rows))))
        std = None if rows[0].std is None else torch.cat([e.std for e in rows if e.std is not None])
        t = torch.tensor([e.t for e in rows], dtype=torch.float64)
        used = torch.tensor([e.gnss_used for e in rows])
        error = torch.cat([e.imu_error for e in rows])
        aids = pd.DataFrame([dict(e.aids or {}) for e in rows])
        parts.append(solution_table(t, rows[0].frame, state, error, std, used).join(aids))
    return pd.concat(parts, ignore_index=True)


def write_solution(path: str | Path, table: pd.DataFrame) -> None:
    """Write ``solution.parquet``: to a file beside, then renamed.

    Behind the columns comes ``geometry``, points as GeoParquet has them, for QGIS, GeoPandas and DuckDB.
    """
    further = [pa.field(name, pa.float64()) for name in table.columns if name not in SCHEMA.names]
    fields = pa.schema([*SCHEMA, *further])
    arrays = [pa.array(table[f.name].to_numpy(), f.type, from_pandas=False) for f in fields]  # NaN stays NaN
    place = table[["lon_deg", "lat_deg", "height_m"]].to_numpy()
    full = fields.append(GEO_SCHEMA.field("geometry")).with_metadata(GEO_SCHEMA.metadata)
    schema.write_parquet(Path(path), pa.Table.from_arrays([*arrays, points(place)], schema=full))


def points(place: np.ndarray) -> pa.Array:
    """Longitude, latitude [°], height [m] (T, 3) as WKB of three-dimensional points (ISO 19125, little-endian)."""
    wkb = np.zeros(len(place), dtype=[("order", "u1"), ("kind", "<u4"), ("xyz", "<f8", 3)])
    wkb["order"], wkb["kind"], wkb["xyz"] = 1, 1001, place
    return pa.FixedSizeBinaryArray.from_buffers(pa.binary(29), len(place), [None, pa.py_buffer(wkb.tobytes())]).cast(
        pa.binary()
    )
