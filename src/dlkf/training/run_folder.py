"""Where a training run keeps what it needs to go on after a kill: a folder named by its configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dlkf.base.errors import InputError
from dlkf.base.files import replace_file
from dlkf.data.store import dataset_digest

STATE = "state.json"


def run_folder(
    name: str, digest: str, *, resume: bool, root: Path = Path("outputs/train")
) -> tuple[Path, dict[str, Any]]:
    """Folder and state of the unfinished run of a configuration's ``digest``, or a new one with an empty state."""
    base = root / name / digest
    attempt = 1
    while True:
        folder = base.with_name(base.name if attempt == 1 else f"{base.name}-{attempt}")
        if not folder.exists():
            return folder, {}
        state = read_state(folder)
        if resume and not state.get("finished"):
            return folder, state
        attempt += 1


def read_state(folder: Path) -> dict[str, Any]:
    """The state file, empty where there is none."""
    path = folder / STATE
    return json.loads(path.read_text()) if path.is_file() else {}


def check_digests(datasets: Sequence[str], state: Mapping[str, Any]) -> dict[str, str]:
    """Digest of every dataset; InputError where an unfinished run began on other data."""
    digests = {str(d): dataset_digest(d) for d in datasets}
    for dataset, before in state.get("data", {}).items():
        if digests.get(dataset) != before:
            raise InputError(
                f"{dataset} is not what the unfinished run began with (digest {digests.get(dataset)}, was {before}): "
                "bring the old data back, or start afresh with resume=false"
            )
    return digests


def write_state(folder: Path, **values: Any) -> None:
    """Merge values into the state file, whole or not at all."""
    with replace_file(folder / STATE) as beside:
        beside.write_text(json.dumps(read_state(folder) | values, indent=1))
