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
    """Navigates whole drives with the trained filter, as ``dlkf navigate`` does."""

    def load_context(self, context) -> None:
        """Read ``weights.safetensors`` and ``config.yaml``."""
        from dlkf.filters.saved import load_filter

        self.filter = load_filter(context.artifacts["filter"])

    def predict(self, context, model_input: pd.DataFrame, params: dict[str, Any] | None = None) -> pd.DataFrame:
        """A table of drives, or of dataset folders, to solutions: ``drive``, then the columns of ``solution.parquet``.

        With folders ``dataset`` comes first, and a filter with vehicle constraints takes their wheel speed, heading and
        barometer. ``params``: ``lever_arm_x_m``, ``_y_m``, ``_z_m``, from the IMU to the antenna (Forward-Right-Down).
        Raises InputError for data that cannot be used, and where no drive can be aligned.
        """
        from dlkf.data.alignment import read_align
        from dlkf.running.offline import navigate_drives

        tables, align = [], read_align()
        for folder, drives, estimator in self._load_drives(model_input, params or {}):
            for result in navigate_drives(drives, estimator, align=align, skipped={}):
                result.table.insert(0, "drive", result.drive)
                if folder:
                    result.table.insert(0, "dataset", folder)
                tables.append(result.table)
        return pd.concat(tables, ignore_index=True)

    def _load_drives(self, given: pd.DataFrame, params: dict[str, Any]) -> Iterator[tuple[str, list, Any]]:
        """A folder, its drives, and the filter with the sensors that they have; of a table no folder."""
        import numpy as np
        import torch

        from dlkf.data.rows import split_drives
        from dlkf.data.store import drive_from_tables, load_dataset
        from dlkf.running.grid import RunPlan, UsableFixes, choose_grid_for_logs

        if "dataset" in given and given["dataset"].notna().any():
            for folder in given["dataset"].dropna().explode():  # MLflow puts a list of words into one cell
                plan = RunPlan.of(folder, self.filter, "model")
                yield folder, load_dataset(folder, dtype=torch.float64, reference=False, **plan.grid), plan.estimator
            return
        arm = [float(params.get(f"lever_arm_{a}_m", 0.0)) for a in "xyz"]
        tables = list(split_drives(given, arm))
        rates = [1 / float(np.median(np.diff(t.imu["t"]))) for t in tables]
        grid = choose_grid_for_logs(self.filter, [UsableFixes.among(t.gnss) for t in tables], rates)
        yield "", [drive_from_tables(t, "", **grid, dtype=torch.float64) for t in tables], self.filter


set_model(NavigationFilter())
