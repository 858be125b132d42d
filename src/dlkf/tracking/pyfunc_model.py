"""The code of a logged model: MLflow stores this file and loads it with the weights beside it (no pickle).

    model = mlflow.pyfunc.load_model("models:/town@champion")
    model.predict(["data/town"])      # a row per drive and second, columns of solution.parquet
"""

from __future__ import annotations

import pandas as pd
from mlflow.models import set_model
from mlflow.pyfunc import PythonModel


class NavigationFilter(PythonModel):
    """Navigates whole drives with the trained filter, from IMU and GNSS alone."""

    def load_context(self, context) -> None:
        """Read ``weights.safetensors`` and ``config.yaml``."""
        from dlkf.filters.saved import load_filter

        self.filter = load_filter(context.artifacts["filter"])

    def predict(self, model_input: list[str]) -> pd.DataFrame:
        """Dataset folders to solutions: columns ``dataset``, ``drive``, then those of ``solution.parquet``.

        Raises InputError for folders that are no dataset, and where no drive can be aligned.
        """
        import torch

        from dlkf.data.store import load_dataset
        from dlkf.running.offline import navigate_drives

        tables = []
        config = self.filter.config
        for folder in model_input:
            drives = load_dataset(
                folder, rate_hz=config.rate_hz, epoch_s=config.epoch_s, dtype=torch.float64, reference=False
            )
            for result in navigate_drives(drives, self.filter, skipped={}):
                table = result.table
                table.insert(0, "drive", result.drive)
                table.insert(0, "dataset", folder)
                tables.append(table)
        return pd.concat(tables, ignore_index=True)


set_model(NavigationFilter())
