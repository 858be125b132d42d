"""Splits share no recording; batches depend on seed, epoch and step alone."""

from __future__ import annotations

import shutil

import lightning as L
import pandas as pd
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from dlkf.base.classes import instantiate
from dlkf.base.errors import InputError
from dlkf.command.composing import compose_command
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.kinds import drive_imus, drive_kinds
from dlkf.data.masks import BiasLaw, Outage, mask_outage, withhold_fixes
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.study import run_scenes
from dlkf.filters.model_based import Ins
from tests.cars import REAL, write_cars


def _module(*folders, **kwargs) -> DriveDataModule:
    defaults = {"length_s": 10.0, "eval_length_s": 20.0, "batch_size": 4, "rate_hz": 10.0}
    return DriveDataModule(list(folders), **{**defaults, **kwargs})


def test_no_group_is_on_two_sides(tmp_path):
    folder = write_cars(tmp_path / "set", 12, groups=5, seconds=20)
    for seed in range(4):
        data = _module(folder, split_seed=seed)
        groups = {side: {d.group for d in data.drives(side)} for side in ("train", "val", "test")}
        assert all(groups.values()) and sum(len(g) for g in groups.values()) == 5
        assert sum(row["drives"] for row in data.summary()) == 12
        segments = {side: {p.drive for p in data.segments(side)} for side in ("val", "test")}
        trained = {p.drive for batch in data.train_segments(0) for p in batch}
        assert (
            not trained & segments["val"] and not trained & segments["test"] and not segments["val"] & segments["test"]
        )


def test_the_same_recording_in_two_datasets_stays_on_one_side(town, tmp_path):
    other = write_cars(tmp_path / "again", 6, seconds=21)
    data = _module(town, other)
    for side in ("train", "val", "test"):
        drives = data.drives(side)
        assert len(drives) == 2 * len({d.group for d in drives})
        assert {d.dataset for d in drives} == {"town", "again"}


def test_a_drive_that_is_given_twice_is_refused(town, tmp_path):
    copy = shutil.copytree(town, tmp_path / "copy")
    for twice in (town, copy):
        with pytest.raises(InputError, match=rf"data.datasets: {twice} has drives of another of them: car-0, car-1"):
            _module(town, twice).setup()


def test_drives_of_one_name_in_two_datasets_keep_their_kind_and_imu(tmp_path):
    """As of real drives and the semi-real ones made of them; a name that is in one dataset alone stays as it is."""
    places = {}
    for folder, count, kind in (("real", 6, "real"), ("semi", 5, "semi-real")):
        places[folder] = write_cars(tmp_path / folder, count, seconds=20 + len(places))
        table = pd.read_parquet(places[folder] / "drives.parquet").assign(kind=kind, imu=f"imu of {folder}")
        table.to_parquet(places[folder] / "drives.parquet")
    data = _module(*places.values(), split={"test": "all"})
    kinds, imus = data.describe_drives(drive_kinds), data.describe_drives(drive_imus)
    assert {d.name for d in data.stack} == set(kinds) == set(imus) and len(kinds) == 11 and kinds["car-5"] == "real"
    for drive in data.stack:
        assert kinds[drive.name] == {"real": "real", "semi": "semi-real"}[drive.dataset]
        assert imus[drive.name] == f"imu of {drive.dataset}"
    scores = run_scenes({"ins": Ins()}, Scenes.of_split(data, "test", None, 0), kinds=kinds)
    assert {(p.drive.split("/")[0], p.kind) for p in scores.segments} == {
        ("real", "real"), ("semi", "semi-real"), ("car-5", "real"),
    }  # fmt: skip
    same = shutil.copytree(places["semi"], tmp_path / "more" / "real")
    with pytest.raises(InputError, match=r"real has the folder name and drives of another of them: car-0, .*rename a"):
        _module(places["real"], same).setup()


def test_named_groups_and_their_mistakes(town):
    data = _module(town, split={"train": "rest", "val": ["day-1"], "test": ["day-0", "day-4"]})
    assert [len(data.drives(s)) for s in ("train", "val", "test")] == [3, 1, 2]
    everything = _module(town, split={"test": "all"})
    assert len(everything.drives("test")) == 6 and everything.val_dataloader() == []
    for split, expected in (
        ({"train": ["day-9"]}, "split.train: no group day-9; has day-0"),
        ({"train": "rest", "test": "all"}, "on one side only"),
        ({"learn": ["day-1"]}, "unknown side learn"),
        ("by_hand", "split=by_hand"),
    ):
        with pytest.raises(InputError, match=expected):
            _module(town, split=split).setup()
    with pytest.raises(InputError, match="needs a group for each of train, val, test, but the drives have only 1"):
        _module(write_cars(town.parent / "single", 1, seconds=20)).setup()
    with pytest.raises(InputError, match="fractions"):
        _module(town, fractions=(0.5, 0.1, 0.1)).setup()
    with pytest.raises(InputError, match="no training segment of 90 s"):
        _module(town, length_s=90).train_segments(0)


def test_without_a_reference_the_data_say_so(tmp_path):
    """Not that the drives are too short."""
    bare = write_cars(tmp_path / "bare", 6, seconds=20)
    shutil.rmtree(bare / "reference")
    with pytest.raises(InputError, match=r"no drive of .*bare has a reference, and training needs one"):
        _module(bare).setup()


def test_the_papers_split_shuffles_blocks(town):
    data = _module(town, split="random", fractions=(0.5, 0.25, 0.25))
    assert [row["segments"] for row in data.summary()] == [9, 5, 4]
    assert [row["minutes"] for row in data.summary()] == pytest.approx([3.0, 1.7, 1.3], abs=0.05)
    used = {side: set() for side in ("train", "val", "test")}
    for side in ("val", "test"):
        used[side] = {(p.drive, p.first + k) for p in data.segments(side) for k in range(p.epochs)}
    for epoch in range(5):
        segments = [p for batch in data.train_segments(epoch) for p in batch]
        used["train"] |= {(p.drive, p.first + k) for p in segments for k in range(p.epochs)}
    assert not used["train"] & used["val"] and not used["train"] & used["test"]


def test_an_epoch_covers_the_training_time_once_from_random_starts(town):
    data = _module(town, split={"train": "all"})
    first = [[p for b in data.train_segments(e) for p in b] for e in range(30)]
    assert {len(segments) for segments in first} == {36}  # 6 drives · 60 s / 10 s
    assert len({tuple(segments) for segments in first}) == 30
    starts = {(p.drive, p.first) for segments in first for p in segments}
    assert len(starts) > 0.9 * 6 * 51  # nearly every possible start has come up
    data.length_law = lambda epoch: 10.0 + 10 * epoch
    assert {p.epochs for b in data.train_segments(2) for p in b} == {30}


def test_batches_depend_on_seed_epoch_and_step_alone(town):
    a, b = (_module(town, injected_bias=BiasLaw(0.1, 0.3)) for _ in range(2))
    b.train_batch(0, 0), b.train_segments(7)
    for epoch, step in ((0, 2), (3, 0)):
        x, y = a.train_batch(epoch, step), b.train_batch(epoch, step)
        assert torch.equal(x.imu, y.imu) and torch.equal(x.start.C_nb, y.start.C_nb) and x.drive == y.drive
    assert not torch.equal(a.train_batch(0, 2).imu, _module(town, seed=1).train_batch(0, 2).imu)


@pytest.mark.parametrize("processes", [2, 3])
def test_processes_share_the_scoring_segments(town, processes):
    """Every segment once, in as many batches for every process: they wait for each other after each."""
    data = _module(town, eval_stride_s=10)
    shares = [data.batches("test", share=(k, processes)) for k in range(processes)]
    assert len({len(batches) for batches in shares}) == 1
    seen = [(d, float(t)) for batches in shares for b in batches for d, t in zip(b.drive, b.t_start)]
    whole = [(d, float(t)) for b in data.batches("test") for d, t in zip(b.drive, b.t_start)]
    assert sorted(seen) == sorted(whole)
    assert max(b.size[0] for b in shares[0]) <= data.batch_size + 1
    with pytest.raises(InputError, match="processes; give trainer"):
        data.batches("test", share=(0, 1000))


def test_scoring_batches_are_fixed(town):
    data = _module(town, eval_outage=Outage(5.0, 10.0), eval_stride_s=10)
    one, two = data.batches("test"), _module(town, eval_outage=Outage(5, 10), eval_stride_s=10).batches("test")
    assert all(torch.equal(x.start.p_n, y.start.p_n) for x, y in zip(one, two))
    plain = _module(town, eval_stride_s=10).batches("test")
    assert torch.equal(withhold_fixes(plain[0], mask_outage(plain[0], 5, 10)).available, one[0].available)
    assert (~one[0].available).sum(1).unique().tolist() == [10]
    assert len(data.describe().splitlines()) == 4


def test_drives_too_short_for_their_side_are_named(town):
    """Which drives, of how many, and the key that takes them in; nothing where all are long enough."""
    data = _module(town)
    assert data.list_left_out(data.train_length_s) == []
    (line,) = data.list_left_out(1e4)
    train = [d.name for d in data.drives("train")]
    assert line.startswith(f"{len(train)} of {len(train)} drives, too short") and "a shorter data.length_s" in line
    assert "train segment of 10000 s: " + ", ".join(train[:4]) in line


class _Recorder(L.LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[tuple] = []

    def training_step(self, batch, step):
        self.seen.append((self.current_epoch, step, batch.size[1], float(batch.start.p_n.sum())))
        return self.weight * 1

    def validation_step(self, batch, step):
        pass

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def _fit(town, folder, checkpoint=None, callbacks=()):
    data, recorder = _module(town), _Recorder()
    data.length_law = lambda epoch: 10.0 + 10 * (epoch // 2)
    trainer = L.Trainer(
        max_epochs=3, logger=False, enable_progress_bar=False, enable_model_summary=False, accelerator="cpu",
        reload_dataloaders_every_n_epochs=1, default_root_dir=folder, callbacks=list(callbacks),
        enable_checkpointing=bool(callbacks),
    )  # fmt: skip
    trainer.fit(recorder, data, ckpt_path=checkpoint)
    return recorder.seen


@pytest.mark.filterwarnings("ignore")
def test_a_resumed_run_sees_the_batches_of_an_uninterrupted_one(town, tmp_path):
    every = ModelCheckpoint(tmp_path, every_n_train_steps=2, save_top_k=-1)
    whole = _fit(town, tmp_path, callbacks=[every])
    assert [x[2] for x in whole if x[0] == 2] == [20] * len([x for x in whole if x[0] == 2])
    for path in sorted(tmp_path.glob("*.ckpt")):
        rest = _fit(town, tmp_path, path)
        assert rest == whole[len(whole) - len(rest) :], path.name
    assert len(list(tmp_path.glob("*.ckpt"))) >= 4


def test_the_config_makes_a_module(town):
    """conf/data with what a user changes; a mapping becomes the settings that it stands for."""
    split = "data.split={train:rest,val:[day-1],test:[day-2]}"
    overrides = [f"data.datasets=[{town}]", split, "data.eval_outage={first_s:10,duration_s:5}", "data.length_s=10"]
    overrides += [
        "start@data.start=coarse",
        "data.injected_bias={accel_mps2:0.1,gyro_dps:0.3}",
        "data.eval_length_s=20",
    ]
    values = compose_command("train", *overrides)["data"]
    data = instantiate(values, "data", ("setup", "describe"))
    assert data.eval_outage == Outage(10.0, 5.0) and data.injected_bias == BiasLaw(0.1, 0.3)
    assert [row["drives"] for row in data.summary()] == [4, 1, 1]
    assert data.train_batch(0, 0).size == (24, 10, 50) and data.start.yaw_deg == 10
    with pytest.raises(InputError, match=r"data\.injected_bias: unknown key gyro"):
        instantiate({**values, "injected_bias": {"gyro": 1.0}}, "data", ("setup", "describe"))


def test_real_drives_load():
    if not (REAL / "kitti").is_dir():
        pytest.skip("real drives are not here")
    data = DriveDataModule([REAL / "kitti", REAL / "rtkx", REAL / "comma2k19"], length_s=20, eval_length_s=20)
    rows = data.summary()
    assert sum(row["drives"] for row in rows) == 45 and sum(row["minutes"] for row in rows) > 50
    batch = data.train_batch(0, 0)
    assert batch.size == (50, 20, 50) and batch.imu.isfinite().all() and batch.start.C_nb.isfinite().all()
    assert batch.truth_valid.all() and batch.truth.p_n.isfinite().all()
