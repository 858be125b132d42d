"""Trained filters that come with the package, by name."""

from __future__ import annotations

from pathlib import Path

from dlkf.filters.plus import PlusFilter
from dlkf.filters.saved import Learned, load_filter
from dlkf.navigation.imu_errors import ImuSpec

WEIGHTS_FOLDER = Path(__file__).parents[1] / "weights"
KNOWN_IMU = "plus_imu"  # plus with biases, scale factors and misalignments of a preset


def shipped_folder(name: str) -> Path | None:
    """Where the weights of a name lie, None for a name that does not come with the package."""
    folder = WEIGHTS_FOLDER / name
    return folder if name.isidentifier() and folder.is_dir() else None


def trained_filter(name: str) -> Learned:
    """A filter with its trained weights: one that comes with the package, or from a folder."""
    return load_filter(shipped_folder(name) or Path(name).expanduser())


def build_plus(imu: ImuSpec) -> PlusFilter:
    """``plus`` for an IMU of which a preset is known; see :meth:`~dlkf.filters.plus.PlusFilter.with_imu`."""
    plus = trained_filter("plus")
    assert isinstance(plus, PlusFilter)
    return plus.with_imu(imu)
