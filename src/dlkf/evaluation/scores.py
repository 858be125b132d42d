"""What every filter made of the same pieces: the raw material of tables and figures."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from dlkf.evaluation.metrics import Array, Mask, Windows, windows


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
    filters: dict[str, FilterRun] = field(default_factory=dict)

    @property
    def t(self) -> Array:
        """Time since the start of a piece at the end of each epoch [s], (T,)."""
        return self.epoch_s * np.arange(1, self.outage.shape[1] + 1)

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
