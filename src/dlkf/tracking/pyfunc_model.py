"""The code of a logged model: MLflow stores this file and loads it with the weights beside it (no pickle).

    model = mlflow.pyfunc.load_model("models:/town@champion")
    model.predict(rows)                        # a table of a drive: IMU samples and fixes
    model.predict({"dataset": ["data/town"]})  # folders in the data contract
    # a row per drive and second: columns of solution.parquet

Served by ``mlflow models serve -m models:/town@champion --env-manager local``, it takes the same table as JSON.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd
from mlflow.models import set_model
from mlflow.pyfunc.model import PythonModel


class NavigationFilter(PythonModel):
    """Navigates whole drives with the trained filter, from IMU and GNSS alone."""

    def load_context(self, context) -> None:
        """Read ``weights.safetensors`` and ``config.yaml``."""
        from dlkf.filters.saved import load_filter

        self.filter = load_filter(context.artifacts["filter"])

    def predict(self, context, model_input: pd.DataFrame, params: dict[str, Any] | None = None) -> pd.DataFrame:
        """A table of drives, or of dataset folders, to solutions: ``drive``, then the columns of ``solution.parquet``.

        With folders ``dataset`` comes first. ``params``: ``lever_arm_x_m``, ``_y_m``, ``_z_m``, from the IMU to the
        antenna (Forward-Right-Down). Raises InputError for data that cannot be used, and where no drive can be aligned.
        """
        from dlkf.running.offline import navigate_drives

        tables = []
        for folder, drives in self._load_drives(model_input, params or {}):
            for result in navigate_drives(drives, self.filter, skipped={}):
                result.table.insert(0, "drive", result.drive)
                if folder:
                    result.table.insert(0, "dataset", folder)
                tables.append(result.table)
        return pd.concat(tables, ignore_index=True)

    def _load_drives(self, given: pd.DataFrame, params: dict[str, Any]) -> Iterator[tuple[str, list]]:
        import torch

        from dlkf.data.rows import split_drives
        from dlkf.data.store import drive_from_tables, load_dataset
        from dlkf.filters.saved import choose_grid

        grid = choose_grid([self.filter])
        rate_hz, epoch_s = grid["rate_hz"], grid["epoch_s"]
        if "dataset" in given and given["dataset"].notna().any():
            for folder in given["dataset"].dropna().explode():  # MLflow puts a list of words into one cell
                options: dict[str, Any] = {"rate_hz": rate_hz, "epoch_s": epoch_s, "reference": False}
                yield folder, load_dataset(folder, dtype=torch.float64, **options)
            return
        arm = [float(params.get(f"lever_arm_{a}_m", 0.0)) for a in "xyz"]
        tables = split_drives(given, arm)
        yield "", [drive_from_tables(t, "", rate_hz, epoch_s, torch.float64) for t in tables]


set_model(NavigationFilter())
