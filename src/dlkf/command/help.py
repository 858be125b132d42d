"""``--help`` of a command: what it does, its groups of presets, and the five keys that matter most.

All of it is read from ``conf/``: the head of the primary file, its defaults list, and the comments behind the keys.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

from dlkf.base.config import config_dir, preset_names

MOST = {
    "simulate": ("dataset.hours", "dataset.drive_minutes", "seed", "out", "overwrite"),
    "ingest": ("source", "out", "overwrite", "split_gaps", "shortest_s"),
    "train": ("data.datasets", "trainer.max_epochs", "seed", "scoring.outage.duration_s", "tracking.uri"),
    "evaluate": ("model", "dataset", "out", "outage.duration_s", "length_s"),
    "navigate": ("model", "dataset", "out", "smoother", "streaming"),
    "tune": ("model", "dataset", "out", "objective", "outage.duration_s"),
    "allan": ("dataset", "name", "out", "drive", "from_s"),
    "consistency": ("model", "drives", "minutes", "outage.duration_s", "out"),
    "export": ("model", "out", "dataset", "rate_hz", "latency"),
    "doctor": ("dataset", "drives"),  # it has no more, as the next two have fewer than five
    "compare": ("runs", "out", "overwrite"),
    "register": ("run", "model", "name", "alias", "tracking.uri"),
}
WIDTH = 118
SILENT = ("hydra_output", "_self_")
ALONE = {"imu": ("auto", "navigate")}  # a preset that one command takes
OPTIONAL = {"train": ("experiment", "profile")}  # groups that the defaults list leaves empty
GROUP = re.compile(
    r"  - (?!override )/?(?P<group>[\w/]+)(?:@(?P<package>[\w.]+))?: (?P<choice>\w+)(?:\s+# (?P<says>.*))?"
)
KEY = re.compile(r"(?P<indent> *)(?P<key>\w+):(?: (?P<value>[^#]*))?(?:# (?P<says>.*))?")


def help_text(name: str, aliases: Mapping[str, str]) -> str:
    """The page of a command; ``aliases``: what a user writes for a group that has another folder."""
    text = (config_dir() / f"{name}.yaml").read_text(encoding="utf-8")
    head = [line.removeprefix("# ").removeprefix("#") for line in _head(text)]
    lines = [*head, "", "Presets (key=name; a folder given by --config-dir adds to them):"]
    for group in list_groups(text):
        key = _group_key(group, aliases)
        lines.append(f"  {key}={group['choice']}" + (f"  {group['says']}" if group["says"] else ""))
        lines += _wrap(list_presets(group["group"], name))
    for folder in OPTIONAL.get(name, ()):
        lines += [f"  +{folder}=…", *_wrap(list_presets(folder, name))]
    if not list_groups(text):
        lines[-1] = "It has no presets."
    lines += ["", "Keys that matter most (key=value):"]
    for key in MOST[name]:
        value, says = describe_key(text, key)
        lines.append(f"  {key}={'…' if value == '???' else value}" + (f"  {says}" if says else ""))
    more = "All keys with their values: --cfg job. Several values, one run each: -m key=a,b. Presets of your own: "
    more += "--config-dir <folder>, laid out as conf/ is (imu/mine.yaml, then imu=mine)."
    return "\n".join([*lines, "", *textwrap.wrap(more, WIDTH)])


def _wrap(names: list[str]) -> list[str]:
    return textwrap.wrap(", ".join(names), WIDTH, initial_indent="      ", subsequent_indent="      ")


def _head(text: str) -> list[str]:
    lines = text.splitlines()
    return lines[: next(k for k, line in enumerate(lines) if not line.startswith("#"))]


def list_groups(text: str) -> list[dict[str, str]]:
    """The defaults list of a file: ``group``, ``package``, ``choice``, ``says``."""
    found = [m.groupdict(default="") for line in text.splitlines() if (m := GROUP.fullmatch(line))]
    return [g for g in found if g["group"] not in SILENT]


def list_presets(group: str, command: str) -> list[str]:
    """Names to choose from."""
    preset, taker = ALONE.get(group, ("", command))
    return [name for name in preset_names(group) if name != preset or command == taker]


def list_keys(text: str) -> dict[str, tuple[str, str]]:
    """Dotted key → (value, comment) of the keys of a file, those below the keys of a group left out."""
    found: dict[str, tuple[str, str]] = {}
    path: list[tuple[int, str]] = []
    for line in text.splitlines():
        if (m := KEY.fullmatch(line)) is None or m["key"] in ("defaults", "override"):
            continue
        indent = len(m["indent"])
        path = [p for p in path if p[0] < indent] + [(indent, m["key"])]
        value, says = (m["value"] or "").strip(), (m["says"] or "").strip()
        dotted = ".".join(key for _, key in path)
        found[dotted] = (value, says)
        for inner in re.finditer(r"(\w+): ([^,{}\[\]]+)", value) if value.startswith("{") else ():
            found[f"{dotted}.{inner[1]}"] = (inner[2].strip(), says)
    return found


def describe_key(text: str, key: str) -> tuple[str, str]:
    """Value and comment of a key, from the file itself or from the preset that its defaults list takes."""
    own = list_keys(text)
    if key in own:
        return own[key]
    for group in list_groups(text):
        package = group["package"] or group["group"]
        if key.startswith(f"{package}."):
            return _in_preset(config_dir() / group["group"], group["choice"], key.removeprefix(f"{package}."))
    raise KeyError(key)


def _in_preset(folder: Path, choice: str, key: str) -> tuple[str, str]:
    text = (folder / f"{choice}.yaml").read_text(encoding="utf-8")
    own = list_keys(text)
    if key in own:
        return own[key]
    for parent in re.findall(r"^  - (\w+)$", text, flags=re.M):
        if parent != "_self_":
            return _in_preset(folder, parent, key)
    raise KeyError(key)


def _group_key(group: Mapping[str, str], aliases: Mapping[str, str]) -> str:
    full = group["group"] + (f"@{group['package']}" if group["package"] else "")
    return next((key for key, folder in aliases.items() if full == f"{folder}@{key}"), full)
