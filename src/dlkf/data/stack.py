"""All drives end to end in one tensor per column, so that cutting segments is a single gather."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property

import torch
from torch import Tensor

from dlkf.base.errors import InputError, no_drives
from dlkf.data.aids import ROW
from dlkf.data.alignment import Aligned, align_boundaries
from dlkf.data.drive import BOUNDARY_COLUMNS, Drive
from dlkf.navigation.geodetic import geodetic_from_ecef


class DriveStack(Sequence[Drive]):
    """A sequence of drives whose tensors are views into the stack's; epochs and boundaries keep their order.

    ``imu`` (ΣN, M, 6); ``rows[name]`` (Σ(N+1), …) for every per-boundary column of :class:`Drive`;
    ``aids[name]`` (Σ(N+1), 5) likewise, of a sensor that at least one drive has, with counts of 0 where one has none.
    ``first_epoch`` and ``first_row`` (drives,) are where a drive begins. Raises InputError if there is no
    drive or their rates or epochs differ.
    """

    def __init__(self, drives: Sequence[Drive]) -> None:
        if not drives:
            raise no_drives()
        for d in drives:
            if (d.rate_hz, d.epoch_s) != (drives[0].rate_hz, drives[0].epoch_s):
                raise InputError(f"drive {d.name}: rate and epoch differ from those of {drives[0].name}; load alike")
        lengths = torch.tensor([d.epochs for d in drives])
        self.epochs = lengths
        self.first_epoch = lengths.cumsum(0) - lengths
        self.first_row = (lengths + 1).cumsum(0) - (lengths + 1)
        self.imu = torch.cat([d.imu for d in drives])
        self.rows = {name: torch.cat([getattr(d, name) for d in drives]) for name in BOUNDARY_COLUMNS}
        names = sorted({name for d in drives for name in d.aids})
        none = [torch.zeros(d.epochs + 1, len(ROW), dtype=torch.float64) for d in drives]
        self.aids = {n: torch.cat([d.aids.get(n, blank) for d, blank in zip(drives, none)]) for n in names}
        self.t0 = torch.tensor([d.t0 for d in drives], dtype=torch.float64)
        self.lever_arm_b = torch.stack([d.lever_arm_b.double() for d in drives])
        self.rate_hz, self.epoch_s = drives[0].rate_hz, drives[0].epoch_s
        self.drives = [
            replace(
                d,
                imu=self.imu[e : e + d.epochs],
                **{name: self.rows[name][r : r + d.epochs + 1] for name in BOUNDARY_COLUMNS},
            )
            for d, e, r in zip(drives, self.first_epoch.tolist(), self.first_row.tolist())
        ]

    def __len__(self) -> int:
        return len(self.drives)

    def __getitem__(self, index):
        return self.drives[index]

    @cached_property
    def aligned(self) -> Aligned:
        """Attitude from IMU and GNSS at every boundary of every drive."""
        parts = [align_boundaries(d) for d in self.drives]
        return Aligned(**{f.name: torch.cat([getattr(a, f.name) for a in parts]) for f in fields(Aligned)})

    @cached_property
    def origin(self) -> Tensor:
        """(rows, 3) latitude, longitude [rad], height [m] of a tangent frame at each boundary: reference,
        else GNSS, else the nearest boundary that has one."""
        r_e = torch.where(self.rows["ref_valid"][:, None], self.rows["ref_r_e"], self.rows["gnss_r_e"])
        llh = torch.stack(geodetic_from_ecef(r_e), -1)
        for first, count in zip(self.first_row.tolist(), (self.epochs + 1).tolist()):
            part = llh[first : first + count]
            known = torch.nonzero(part.isfinite().all(-1)).flatten()
            if len(known) and len(known) < count:
                at = torch.arange(count)
                right = torch.searchsorted(known, at).clamp(max=len(known) - 1)
                left = (right - 1).clamp_min(0)
                nearer = (at - known[left]).abs() <= (known[right] - at).abs()
                llh[first : first + count] = part[torch.where(nearer, known[left], known[right])]
        return llh

    @cached_property
    def start_from_truth(self) -> Tensor:
        """(rows,) bool: position, velocity and full attitude of the reference are known."""
        return self.rows["ref_valid"] & self.rows["ref_C_eb"].isfinite().flatten(1).all(-1)


def stack_drives(drives: Sequence[Drive]) -> DriveStack:
    """The drives as a stack; a stack is returned as it is."""
    return drives if isinstance(drives, DriveStack) else DriveStack(drives)
