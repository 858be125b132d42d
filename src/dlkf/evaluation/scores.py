"""What every filter made of the same pieces: the raw material of tables and figures."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch

from dlkf.evaluation.metrics import Array, Mask, Windows, windows
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef


@dataclass(frozen=True)
class Piece:
    """Where a row of the scores comes from. ``kind``: simulated, semi-real or real."""

    drive: str
    group: str
    kind: str
    t_start: float  # s, the drive's own clock


@dataclass
class FilterRun:
    """One filter over all P pieces; rows as in :class:`Scores`."""

    error: Array  # (P, T, 9) truth − estimate, see metrics.error_series
    p_n: Array  # (P, T, 3) estimated position in the piece's tangent frame
    imu_error: Array  # (P, T, 6) estimate
    imu_std: Array  # (P, T, 6) its 1σ, NaN where the filter has none


@dataclass
class Scores:
    """P pieces of up to T epochs (NaN-padded) and what each filter made of them."""

    epoch_s: float
    pieces: list[Piece]
    outage: Mask  # (P, T) fix withheld
    truth_p_n: Array  # (P, T, 3)
    truth_v_n: Array  # (P, T, 3)
    true_imu_error: Array  # (P, T, 6)
    origin_e: Array  # (P, 3) ECEF of the tangent frames' origins
    filters: dict[str, FilterRun] = field(default_factory=dict)

    @property
    def t(self) -> Array:
        """Time since the start of a piece at the end of each epoch [s], (T,)."""
        return self.epoch_s * np.arange(1, self.outage.shape[1] + 1)

    def geodetic(self, piece: int, p_n: Array) -> Array:
        """Latitude and longitude [°] (…, 2) of positions (…, 3) in the tangent frame of a piece."""
        origin = torch.from_numpy(self.origin_e[piece])
        lat, lon, _ = geodetic_from_ecef(origin)
        r_e = origin + torch.from_numpy(np.asarray(p_n, float)) @ ned_axes(lat, lon).mT
        return np.degrees(np.stack([x.numpy() for x in geodetic_from_ecef(r_e)[:2]], -1))

    @property
    def windows(self) -> Windows:
        """All outages."""
        return windows(self.outage)

    @property
    def kinds(self) -> list[str]:
        """Kinds of data among the pieces, sorted."""
        return sorted({p.kind for p in self.pieces})

    def of_kind(self, kind: str) -> Scores:
        """The pieces of one kind: simulated and real results are never mixed."""
        keep = [i for i, p in enumerate(self.pieces) if p.kind == kind]
        part = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        runs = {
            n: FilterRun(**{f.name: getattr(r, f.name)[keep] for f in fields(r)})
            for n, r in self.filters.items()
        }
        return replace(self, pieces=[self.pieces[i] for i in keep], filters=runs, **part)
