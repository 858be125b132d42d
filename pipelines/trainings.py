"""Trainings one after the other as one study, resumed after a kill; in MLflow a parent with children."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dlkf.base.files import replace_file
from dlkf.tracking.grid import PARENT_RUN, parent_status
from dlkf.tracking.runs import experiment_id, open_client, tracking_uri


def arguments(doc: str | None, seeds: str, each: str) -> argparse.ArgumentParser:
    """What every chain of trainings takes; other words are key=value for ``dlkf.train``.

    ``seeds`` is the default, ``each`` is the cost of one seed.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", default=seeds, type=lambda given: given.split(","), help=each)
    return parser


class Study:
    """A folder with a record of its finished trainings and their reports."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "trainings.json"
        self.done: dict[str, str] = json.loads(self.file.read_text()) if self.file.is_file() else {}

    def remember(self, key: str, value: str) -> None:
        """Safe against a kill."""
        self.done[key] = value
        with replace_file(self.file) as beside:
            beside.write_text(json.dumps(self.done, indent=1))

    def train(self, key: str, *overrides: str) -> Path:
        """Run folder of ``python -m dlkf.train`` with these overrides; a training that was killed goes on."""
        if key in self.done and Path(self.done[key]).is_dir():
            return Path(self.done[key])
        said = run("train", *overrides)
        report = next(line for line in reversed(said) if line.startswith("Report:"))
        folder = Path(report.removeprefix("Report:").strip()).parents[1]  # of report/report.html
        self.remember(key, str(folder))
        return folder

    @contextmanager
    def parent(self, experiment: str, name: str) -> Iterator[None]:
        """One MLflow run above all trainings inside, the same one when the study goes on after a kill."""
        uri = tracking_uri(None)
        client = open_client(uri)
        if "parent" not in self.done:
            self.remember("parent", client.create_run(experiment_id(client, experiment), run_name=name).info.run_id)
        os.environ[PARENT_RUN] = self.done["parent"]
        try:
            yield
        except BaseException:
            client.set_terminated(self.done["parent"], parent_status(["KILLED"], ended=False))
            raise
        finally:
            os.environ.pop(PARENT_RUN, None)
        client.set_terminated(self.done["parent"], "FINISHED")


def run(command: str, *arguments: str) -> list[str]:
    """One command of dlkf, shown as it goes; its lines. A failure ends the chain with the command's code."""
    print(f"\n$ python -m dlkf.{command} {' '.join(arguments)}", flush=True)
    lines = []
    words = [sys.executable, "-m", f"dlkf.{command}", *arguments]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as p:
        for line in p.stdout or ():
            print(line, end="", flush=True)
            lines.append(line.rstrip("\n"))
    if p.returncode:
        sys.exit(p.returncode)
    return lines
