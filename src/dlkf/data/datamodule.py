"""Drives as training, validation and test batches for Lightning; all in memory, no worker processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError, list_some
from dlkf.data.draws import combine_seed
from dlkf.data.drive import Batch, Drive
from dlkf.data.masks import BiasLaw, GnssNoise, Outage, add_bias, mask_outage, withhold_fixes
from dlkf.data.resampling import samples_per_epoch
from dlkf.data.segments import (
    Segment,
    StartLaw,
    count_epochs,
    cut_segments,
    describe_unused_drives,
    find_unused_drives,
    make_batch,
    make_segments,
    possible_starts,
)
from dlkf.data.splits import SIDES, Split, split_rows
from dlkf.data.stack import DriveStack
from dlkf.data.store import load_dataset

DTYPES = {"float32": torch.float32, "float64": torch.float64}


class DriveDataModule(L.LightningDataModule):
    """Segments of any number of datasets, split by recording (paper.md 4.8), as :class:`Batch` objects.

    Training: in every epoch segments of ``length_s`` (or ``length_law(epoch)`` where a curriculum sets
    that attribute) start at random, spread evenly over the training drives, with a start error drawn from
    ``start``. Batches depend on (seed, epoch, step) alone, so a resumed run gets the batches that an uninterrupted one
    gets; with several processes each makes the whole batch. Validation and test segments of
    ``eval_length_s`` every ``eval_stride_s`` have start errors drawn from ``eval_seed``, each segment its own, so that
    they are the same for every ``seed`` and ``batch_size``; ``eval_outage`` withholds GNSS
    there. Lengths that change need ``Trainer(reload_dataloaders_every_n_epochs=1)``.

    Groups of the same name in several datasets count as one recording; drives of the same name are called
    ``<folder>/<drive>`` here. ``split`` and ``fractions`` as in
    :func:`dlkf.data.splits.split_rows`; ``injected_bias`` (``accel_mps2``, ``gyro_dps``: 1σ) augments training.
    """

    def __init__(
        self,
        datasets: Sequence[str | Path] | str | Path,
        *,
        rate_hz: float = 50.0,
        epoch_s: float = 1.0,
        dtype: str = "float32",
        split: Split = "group",
        fractions: Sequence[float] = (0.7, 0.15, 0.15),
        batch_size: int = 50,
        length_s: float = 60.0,
        eval_length_s: float = 60.0,
        eval_stride_s: float | None = None,
        eval_outage: Outage | None = None,
        start: StartLaw | None = None,
        gnss_noise: GnssNoise | None = None,
        injected_bias: BiasLaw | None = None,
        seed: int = 0,
        eval_seed: int = 0,
        split_seed: int = 0,
        progress: ProgressCallback = no_progress,
    ) -> None:
        super().__init__()
        if dtype not in DTYPES:
            raise InputError(f"dtype={dtype}: must be {' or '.join(DTYPES)}")
        if batch_size < 1:
            raise InputError(f"batch_size={batch_size}: must be ≥ 1")
        samples_per_epoch(rate_hz, epoch_s)
        self.datasets = [str(d) for d in ([datasets] if isinstance(datasets, (str, Path)) else datasets)]
        self.rate_hz, self.epoch_s, self.dtype = rate_hz, epoch_s, DTYPES[dtype]
        self.split, self.fractions = split, tuple(fractions)
        self.batch_size, self.train_length_s = batch_size, length_s
        self.eval_length_s, self.eval_stride_s = eval_length_s, eval_stride_s
        self.eval_outage, self.injected_bias, self.gnss_noise = eval_outage, injected_bias, gnss_noise
        self.start = start or StartLaw()
        self.seed, self.eval_seed, self.split_seed, self.progress = seed, eval_seed, split_seed, progress
        self.length_law: Callable[[int], float] | None = None
        self._starts: dict[int, torch.Tensor] = {}
        self._latest: tuple[int, int, list[list[Segment]]] = (-1, -1, [])

    def setup(self, stage: str | None = None) -> None:
        """Load, stack and split the drives; does nothing when that is done."""
        if hasattr(self, "stack"):
            return
        grid = {"rate_hz": self.rate_hz, "epoch_s": self.epoch_s, "dtype": self.dtype, "progress": self.progress}
        loaded = [load_dataset(folder, **grid) for folder in self.datasets]
        self._names = name_apart(self.datasets, loaded)
        named = zip(loaded, self._names)
        drives = [replace(drive, name=names[drive.name]) for more, names in named for drive in more]
        if not any(bool(d.ref_valid.any()) for d in drives):
            raise InputError(
                f"no drive of {', '.join(self.datasets)} has a reference, and training needs one: position, velocity "
                "and attitude of a better system in reference/"
            )
        if self.gnss_noise is not None:
            drives = [self.gnss_noise.add_noise(d, self.eval_seed) for d in drives]
        self.stack = DriveStack(drives)
        self.spans = split_rows(self.stack, self.split, self.fractions, self.split_seed, self.eval_length_s)

    def describe_drives(self, read: Callable[[str], Mapping[str, str]]) -> dict[str, str]:
        """What ``read`` gives of each dataset by the names of its drives, of all by the names that they have here."""
        self.setup()
        pairs = zip(self.datasets, self._names)
        return {names[drive]: value for folder, names in pairs for drive, value in read(folder).items()}

    def drives(self, side: str) -> list[Drive]:
        """The drives that have something on a side (``train``, ``val``, ``test``)."""
        self.setup()
        spans = self.spans[side]
        ends = zip(self.stack.first_row.tolist(), self.stack.epochs.tolist())
        return [d for d, (row, n) in zip(self.stack, ends) if bool((spans[row : row + n] >= 0).any())]

    def length_s(self, epoch: int) -> float:
        """Length of the training segments in an epoch [s]."""
        return self.train_length_s if self.length_law is None else self.length_law(epoch)

    def train_segments(self, epoch: int) -> list[list[Segment]]:
        """The segments of an epoch, batch by batch: one start drawn from each of as many equal parts of all
        possible starts as segments fit into the training time, in random order."""
        self.setup()
        length = count_epochs(self.length_s(epoch), self.epoch_s)
        if self._latest[:2] == (epoch, length):
            return self._latest[2]
        if length not in self._starts:
            allowed = possible_starts(self.stack, length, span=self.spans["train"])
            self._starts[length] = torch.nonzero(allowed).flatten()
        starts = self._starts[length]
        if not len(starts):
            raise InputError(
                f"no training segment of {length * self.epoch_s:g} s: the drives are shorter or not valid that "
                "long; choose a shorter data.length_s"
            )
        change = torch.zeros(len(self.spans["train"]) + 1, dtype=torch.int64)
        change[starts] += 1
        change[starts + length] -= 1
        count = max(1, int((change.cumsum(0) > 0).sum()) // length)  # epochs that some segment covers
        rng = np.random.default_rng((self.seed, epoch))
        part = (np.arange(count) + rng.random(count)) / count
        rows = starts[torch.from_numpy((part * len(starts)).astype(np.int64))]
        segments = make_segments(self.stack, rows[torch.from_numpy(rng.permutation(count))], length)
        batches = [segments[k : k + self.batch_size] for k in range(0, count, self.batch_size)]
        self._latest = (epoch, length, batches)
        return batches

    def train_batch(self, epoch: int, step: int) -> Batch:
        """The batch of a training step."""
        generator = torch.Generator().manual_seed(combine_seed(self.seed, epoch, step))
        segments = self.train_segments(epoch)[step]
        batch = make_batch(self.stack, segments, dtype=self.dtype, start=self.start, generator=generator)
        if self.injected_bias is not None:
            noise = torch.randn(batch.size[0], 6, generator=generator, dtype=torch.float64)
            batch = add_bias(batch, self.injected_bias.std * noise)
        return batch

    def segments(self, side: str) -> list[Segment]:
        """The fixed segments of a side, for scoring."""
        self.setup()
        segments = cut_segments(self.stack, self.eval_length_s, self.eval_stride_s, span=self.spans[side])
        if not segments:
            raise InputError(
                f"no {side} segment of {self.eval_length_s:g} s: its drives are shorter or not valid "
                "that long; choose a shorter data.eval_length_s or another split"
            )
        return segments

    def batches(self, side: str, *, share: tuple[int, int] = (0, 1)) -> list[Batch]:
        """The fixed batches of a side, with the same start errors for every filter and in every run.

        ``share`` = (k, n) takes every n-th segment from k on, in as many batches for every k.
        """
        (k, n), segments, out = share, self.segments(side), []
        if len(segments) < n:
            raise InputError(f"{len(segments)} {side} segments for {n} processes; give trainer.devices={len(segments)}")
        starts = range(0, len(segments) - n + 1, n * self.batch_size)
        for first, last in zip(starts, [*starts[1:], len(segments)]):
            part = segments[first:last][k::n]
            batch = make_batch(self.stack, part, dtype=self.dtype, start=self.start, seed=self.eval_seed)
            if self.eval_outage is not None:
                batch = withhold_fixes(batch, mask_outage(batch, self.eval_outage.first_s, self.eval_outage.duration_s))
            out.append(batch)
        return out

    def train_dataloader(self) -> TrainBatches:
        """Batches of the epoch that the trainer is in."""
        return TrainBatches(self)

    def val_dataloader(self) -> FixedBatches | list:
        """Validation batches; no loader where the split has no validation side."""
        return FixedBatches(self.batches("val", share=self.share)) if self.drives("val") else []

    def summary(self) -> list[dict[str, Any]]:
        """Per side: drives, groups, minutes of driving, and segments for scoring."""
        table = []
        for side in SIDES:
            drives, span = self.drives(side), self.spans[side]
            segments = cut_segments(self.stack, self.eval_length_s, self.eval_stride_s, span=span)
            ends = self.stack.first_row + self.stack.epochs  # the last boundary begins no epoch
            epochs = int((span >= 0).sum() - (span[ends] >= 0).sum())
            table.append(
                {
                    "split": side,
                    "drives": len(drives),
                    "groups": len({d.group for d in drives}),
                    "minutes": round(epochs * self.epoch_s / 60, 1),
                    "segments": len(segments),
                }
            )
        return table

    def list_left_out(self, longest_s: float) -> list[str]:
        """A line per side on its drives that give no segment on any; training segments grow to ``longest_s``."""
        fixed = ("data.eval_length_s", self.eval_length_s)
        lengths = dict.fromkeys(SIDES, fixed) | {"train": ("data.length_s", longest_s)}
        sides = {side: [d.name for d in self.drives(side)] for side in SIDES}
        cut = [cut_segments(self.stack, length, span=self.spans[side]) for side, (_, length) in lengths.items()]
        idle = find_unused_drives(self.stack, [segment for segments in cut for segment in segments])
        out = []
        for side, (key, length) in lengths.items():
            if names := [name for name in idle if name in sides[side]]:
                segment = f"{side} segment of {length:g} s"
                out.append(
                    describe_unused_drives(names, len(sides[side]), segment, f"a shorter {key} takes more of them")
                )
        return out

    def describe(self) -> str:
        """The summary as a small table."""
        row = "{split:<6} {drives:>7} {groups:>7} {minutes:>8.1f} {segments:>7}"
        return "\n".join(("split   drives  groups  minutes  segments", *(row.format(**r) for r in self.summary())))

    @property
    def share(self) -> tuple[int, int]:
        """Number of this process, and how many there are."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


def name_apart(datasets: Sequence[str], loaded: Sequence[Sequence[Drive]]) -> list[dict[str, str]]:
    """For each dataset the names of its drives among all: ``<folder>/<drive>`` where another has a drive of that name.

    InputError for the same drive in two datasets, or two drives of one name in folders of one name.
    """
    seen: dict[str, list[Drive]] = {}
    for folder, drives in zip(datasets, loaded):
        if twice := [d.name for d in drives if any(torch.equal(d.imu, other.imu) for other in seen.get(d.name, ()))]:
            raise InputError(f"data.datasets: {folder} has drives of another of them: {list_some(twice, 4)}; give one")
        if alike := [d.name for d in drives if any(d.dataset == other.dataset for other in seen.get(d.name, ()))]:
            raise InputError(
                f"data.datasets: {folder} has the folder name and drives of another of them: {list_some(alike, 4)}; "
                "rename a folder"
            )
        for drive in drives:
            seen.setdefault(drive.name, []).append(drive)
    return [
        {d.name: d.name if len(seen[d.name]) == 1 else f"{d.dataset}/{d.name}" for d in drives} for drives in loaded
    ]


class TrainBatches:
    """The training batches of the trainer's epoch, one pass; its state resumes inside an epoch."""

    def __init__(self, module: DriveDataModule) -> None:
        self.module = module
        self.step = 0
        self._resume: tuple[int, int] | None = None

    @property
    def epoch(self) -> int:
        """The trainer's epoch; 0 outside a trainer."""
        return self.module.trainer.current_epoch if self.module.trainer is not None else 0

    def _steps(self, epoch: int) -> int:
        _, world = self.module.share
        return sum(len(batch) >= world for batch in self.module.train_segments(epoch))

    def __len__(self) -> int:
        return self._steps(self.epoch)

    def __iter__(self) -> Iterator[Batch]:
        epoch, self.step = self.epoch, 0
        if self._resume is not None and self._resume[0] == epoch:
            self.step = self._resume[1]
        self._resume = None
        while self.step < self._steps(epoch):
            self.step += 1
            yield self.module.train_batch(epoch, self.step - 1)

    def state_dict(self) -> dict[str, int]:
        """Epoch and number of batches given out."""
        return {"epoch": self.epoch, "step": self.step}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on in that epoch after that many batches."""
        self._resume = (state["epoch"], state["step"])


class FixedBatches:
    """A loader with the same batches in every pass (Lightning takes a list for several loaders)."""

    def __init__(self, batches: Sequence[Batch]) -> None:
        self.batches = batches

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Batch]:
        return iter(self.batches)
