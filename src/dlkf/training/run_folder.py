"""Where a training run keeps what it needs to go on after a kill: a folder named by its configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dlkf.base.errors import InputError
from dlkf.base.files import replace_file
from dlkf.base.own_code import digest_modules, find_own_modules
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


def check_digests(
    datasets: Sequence[str], config: Mapping[str, Any], state: Mapping[str, Any]
) -> dict[str, dict[str, str]]:
    """Digests of every dataset (``data``) and of every module of a user's that the configuration names (``code``).

    InputError where an unfinished run began with others.
    """
    data, code = {str(d): dataset_digest(d) for d in datasets}, digest_modules(find_own_modules(config))
    for kind, digests in (("data", data), ("code", code)):
        for name, before in state.get(kind, {}).items():
            if digests.get(name) != before:
                raise InputError(
                    f"{name} is not what the unfinished run began with (digest {digests.get(name)}, was {before}): "
                    f"bring the old {kind} back, or start afresh with resume=false"
                )
    return {"data": data, "code": code}


def write_state(folder: Path, **values: Any) -> None:
    """Merge values into the state file, whole or not at all."""
    with replace_file(folder / STATE) as beside:
        beside.write_text(json.dumps(read_state(folder) | values, indent=1))
