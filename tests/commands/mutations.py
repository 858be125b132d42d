"""Datasets and models that are spoilt at random, by a seed: what a broken logger, disk or stranger may hand in."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml
from safetensors.torch import load_file, save_file

VALUES = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    -1.0,
    1.0,
    7.0,
    300.0,
    1e-300,
    5e-324,
    1e3,
    -1e3,
    1e6,
    -1e9,
    1e15,
    2.0**53 + 2,
    2.0**63,
    1e30,
    -1e30,
    1e200,
    1e300,
    1.7e308,
)
NAMES = (
    "../evil",
    "a/b",
    "a=b",
    ".hidden",
    "",
    " ",
    "x" * 300,
    "é" * 150,
    "a\nb",
    "$(touch x)",
    "%2F",
    "\u202e",
    "a\0b",
)
TYPES = (
    pa.int64(),
    pa.int8(),
    pa.uint64(),
    pa.float32(),
    pa.float16(),
    pa.string(),
    pa.bool_(),
    pa.binary(),
    pa.timestamp("ns"),
    pa.list_(pa.float64()),
    pa.decimal128(38, 3),
    pa.null(),
    pa.dictionary(pa.int32(), pa.float64()),
)
CLOCKS = ("gps_zero_s", "gps_rate", "time_zero_s", "imu_rate_hz", "gnss_rate_hz", "duration_s")


def mutate_dataset(folder: Path, seed: int) -> str:
    """Spoil one table of a dataset; what was done."""
    rng = random.Random(seed)
    how = rng.choices(("values", "column", "rows", "bytes", "file", "drives"), (8, 4, 3, 2, 1, 4))[0]
    path = folder / "drives.parquet" if how == "drives" else rng.choice(sorted(folder.glob("[igr]*/*/*.parquet")))
    where = f"{how} of {path.relative_to(folder)}: "
    return where + {
        "values": _values,
        "column": _column,
        "rows": _rows,
        "bytes": _bytes,
        "file": _file,
        "drives": _drives,
    }[how](path, rng)


def _values(path: Path, rng: random.Random) -> str:
    table = pd.read_parquet(path, partitioning=None)
    column, value = rng.choice([c for c in table if table[c].dtype != object]), rng.choice(VALUES)
    rows = {
        "one": slice((k := rng.randrange(len(table))), k + 1),
        "all": slice(None),
        "every 97th": slice(None, None, 97),
        "from half on": slice(len(table) // 2, None),
        "first": slice(0, 1),
        "last": slice(-1, None),
    }
    which = rng.choice(list(rows))
    changed = table[column].to_numpy(float).copy()
    factor = rng.random() < 0.25
    changed[rows[which]] = changed[rows[which]] * value if factor else value
    table[column] = changed
    table.to_parquet(path, index=False)
    return f"{column} {'times' if factor else '='} {value:g} in {which}"


def _column(path: Path, rng: random.Random) -> str:
    table = pq.ParquetFile(path).read()
    k = rng.randrange(table.num_columns)
    name, how = table.column_names[k], rng.choice(("type", "drop", "twice", "rename", "nulls"))
    if how == "drop":
        table = table.drop_columns([name])
    elif how == "twice":
        table = table.append_column(name, table[k])
    elif how == "rename":
        table = table.rename_columns([n.upper() if n == name else n for n in table.column_names])
    elif how == "nulls":
        table = table.set_column(k, name, pa.nulls(len(table), table[k].type))
    else:
        kind = rng.choice(TYPES)
        how = str(kind)
        table = table.set_column(k, name, _as_type(table[k], kind))
    pq.write_table(table, path)
    return f"{name} {how}"


def _as_type(column: pa.ChunkedArray, kind: pa.DataType) -> pa.Array | pa.ChunkedArray:
    try:
        if pa.types.is_list(kind):
            return pa.array([[x] for x in column.to_pylist()], kind)
        if pa.types.is_dictionary(kind):
            return column.dictionary_encode()
        return column.cast(kind, safe=False)
    except pa.ArrowException:
        return pa.nulls(len(column), kind)


def _rows(path: Path, rng: random.Random) -> str:
    table = pd.read_parquet(path, partitioning=None)
    n = len(table)
    how = rng.choice(("none", "one", "two", "shuffled", "reversed", "doubled", "half", "thinned", "a gap", "t moved"))
    if how == "t moved":
        moved = rng.choice((1e6, -1e6, 1e15, 0.3, -20.0, 1e-9))
        table["t"] += moved
        how += f" by {moved:g}"
    else:
        order = {
            "none": [],
            "one": [0],
            "two": [0, 1],
            "shuffled": rng.sample(range(n), n),
            "reversed": range(n)[::-1],
            "doubled": sorted([*range(n), *range(n)]),
            "half": range(n // 2),
            "thinned": range(0, n, 41),
            "a gap": [k for k in range(n) if not n // 3 < k < n // 2],
        }[how]
        table = table.iloc[list(order)]
    table.to_parquet(path, index=False)
    return how


def _bytes(path: Path, rng: random.Random) -> str:
    data = bytearray(path.read_bytes())
    how = rng.choice(("cut", "flipped", "flipped", "garbage", "empty", "doubled"))
    if how == "cut":
        data = data[: rng.randrange(len(data))]
    elif how == "flipped":
        for _ in range(5):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif how == "garbage":
        data = bytearray(rng.randbytes(5000))
    elif how == "empty":
        data = bytearray()
    else:
        data = data * 2
    path.write_bytes(data)
    return how


def _file(path: Path, rng: random.Random) -> str:
    how = rng.choice(("gone", "a folder", "a pipe", "a loop", "a device", "another table"))
    data = path.read_bytes()
    path.unlink()
    if how == "a folder":
        path.mkdir()
    elif how == "a pipe":
        os.mkfifo(path)
    elif how == "a loop":
        path.symlink_to(path)
    elif how == "a device":
        path.symlink_to("/dev/zero")
    elif how == "another table":
        (path.parent / "part-1.parquet").write_bytes(data)
        path.write_bytes(data)
    return how


def _drives(path: Path, rng: random.Random) -> str:
    if rng.random() < 0.3:
        return rng.choice((_bytes, _file, _column))(path, rng)
    table = pd.read_parquet(path)
    column = rng.choice(("drive", "group", "imu", *CLOCKS, *(f"lever_arm_{a}_m" for a in "xyz")))
    value = rng.choice(NAMES if column in ("drive", "group", "imu") else VALUES)
    if column not in table:
        table[column] = np.nan
    table.loc[rng.randrange(len(table)), column] = value
    table.to_parquet(path, index=False)
    return f"{column} = {value!r:.40}"


BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{k + 1}: &a{k + 1} [{', '.join(['*a' + str(k)] * 10)}]\n" for k in range(9)
)
TEXTS = (
    "",
    "a: [1",
    "- a\n- b\n",
    "3",
    "null",
    "[" * 5000,
    "{" * 5000,
    "&a [*a]",
    "\x00\x01",
    "\ufeffkind: dlkf",
    "kind: [dlkf]",
    "kind: {a: b}",
    "kind: os:system",
    "!!python/object/apply:os.system ['touch pwned']",
    "_target_: os.system\ncommand: touch pwned",
    "kind: dlkf\nnetwork: {_target_: os.system, command: touch pwned}",
    "kind: dlkf\nnetwork: {_target_: subprocess.Popen, args: [touch, pwned]}",
    BOMB + "kind: *a9\n",
    BOMB + "datasets: *a9\nimus: *a9\n",
    "datasets: 3\n",
    "imus: 4\n",
    "trained_on: {a: b}\n",
    "imus: [[a]]\n",
    "datasets: [a, b]\n",
    "trained_on: 2011-01-01\n",
    "? [a]\n: b\n",
    "a" * 5_000_000,
)


def mutate_model(folder: Path, seed: int) -> str:
    """Spoil one file of a model; what was done."""
    rng = random.Random(seed)
    how = rng.choice((_text, _text, _setting, _weights, _weights, _raw))
    return how(folder, rng)


def _text(folder: Path, rng: random.Random) -> str:
    name, text = rng.choice(("config.yaml", "card.yaml")), rng.choice(TEXTS)
    (folder / name).write_bytes(text.encode("utf-8"))
    return f"{name} is {text!r:.60}"


def _setting(folder: Path, rng: random.Random) -> str:
    values = yaml.safe_load((folder / "config.yaml").read_text())
    inside = rng.choice([values, *(v for v in values.values() if isinstance(v, dict))])
    key = rng.choice(list(inside))
    inside[key] = rng.choice(
        (None, "x", [], {}, -1, 0, 1.5, 10**7, 10**12, math.nan, math.inf, True, [1] * 9, {"a": 1})
    )
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    return f"config.yaml {key} = {inside[key]!r}"


def _weights(folder: Path, rng: random.Random) -> str:
    path = folder / "weights.safetensors"
    weights = load_file(path)
    name = rng.choice(sorted(weights))
    changes: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "complex": lambda w: w.to(torch.complex64),
        "int": lambda w: w.to(torch.int64),
        "bool": lambda w: w.to(torch.bool),
        "half": lambda w: w.to(torch.float16),
        "NaN": lambda w: w * math.nan,
        "transposed": lambda w: w.flatten(),
        "huge": lambda w: w * 1e37,
    }
    how = rng.choice([*changes, "gone", "more"])
    if how == "gone":
        del weights[name]
    elif how == "more":
        weights["another"] = torch.zeros(3)
    else:
        weights[name] = changes[how](weights[name])
    save_file(weights, path)
    return f"{name} {how}"


def _raw(folder: Path, rng: random.Random) -> str:
    return _bytes(folder / "weights.safetensors", rng) if rng.random() < 0.7 else _file(folder / "config.yaml", rng)
