"""A tiny simulated dataset, and the commands called as from a shell but without a new interpreter."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dlkf.config import config_dir
from dlkf.simulation.dataset import simulate_from_config

SIZE = ("dataset.hours=0.05", "dataset.drive_minutes=1.5", "dataset.imu_rate_hz=50", "seed=3")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


def in_shell(folder: Path, command: str, *arguments: object) -> Ended:
    """A command in an interpreter of its own, as a user starts it."""
    done = subprocess.run(
        [sys.executable, "-m", f"dlkf.{command}", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    return Ended(done.returncode, done.stdout, done.stderr)


@pytest.fixture
def call(tmp_path, monkeypatch, capfd):
    """``call("evaluate", "model=ins", …)`` runs the command's main in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(command: str, *arguments: object) -> Ended:
        main = importlib.import_module(f"dlkf.{command}").main
        monkeypatch.setattr(sys, "argv", [f"dlkf.{command}", *map(str, arguments)])
        capfd.readouterr()
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        out, err = capfd.readouterr()
        return Ended(code, out, err)

    return run


@pytest.fixture(scope="session")
def town(tmp_path_factory) -> Path:
    """Two drives of 90 s in a town."""
    with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
        config = compose("simulate", ["simulated@dataset=per_drive", "dataset.name=town", *SIZE])
    folder = tmp_path_factory.mktemp("data") / "town"
    return simulate_from_config(OmegaConf.to_container(config, resolve=True), folder, progress=False)
