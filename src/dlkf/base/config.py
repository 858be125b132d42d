"""Where the configuration lives: in the wheel, or at the top of the repository."""

from __future__ import annotations

from pathlib import Path

from dlkf.base.errors import InputError


def config_dir() -> Path:
    """Absolute path of ``conf/``: the packaged copy if there is one, else the repository's."""
    here = Path(__file__).resolve().parent
    for folder in (here.parent / "conf", here.parents[2] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise InputError("the configuration folder conf/ is missing from this installation; install dlkf again")
