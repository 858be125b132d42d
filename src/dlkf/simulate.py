"""Simulated drives as a dataset: ``python -m dlkf.simulate dataset=per_drive imu=consumer``."""

from __future__ import annotations

import time

from omegaconf import DictConfig, OmegaConf

from dlkf.command import command
from dlkf.simulation.dataset import simulate_from_config


@command("simulate")
def main(cfg: DictConfig) -> None:
    """Write the dataset to ``out`` (default ``data/<name>``) and say what it holds."""
    start = time.perf_counter()
    config = OmegaConf.to_container(cfg, resolve=True)
    out = simulate_from_config(config, config["out"], overwrite=config["overwrite"])
    print(
        f"{out}: {config['dataset']['hours']:g} h of drives with IMU {config['imu']['name']} "
        f"({config['dataset']['imu_errors']}), seed {config['seed']}, in {time.perf_counter() - start:.1f} s"
    )


if __name__ == "__main__":
    main()
