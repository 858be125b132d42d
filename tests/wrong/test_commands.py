"""Words on the command line that a newcomer gets wrong: one line each, which points the right way."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.commands.refusals import FAST, is_refused
from tests.wrong.test_calls import CALLS
from tests.wrong.test_frames import BAD_FRAMES

SOLVE = ("navigate", "dataset=town", "out=made", "model=mbkf15", *FAST["navigate"])
SCORE = ("evaluate", "dataset=town", "out=made", "model=mbkf15", *FAST["evaluate"])
COMMANDS: dict[str, tuple[tuple[str, ...], str]] = {
    "a key misspelt": ((*SOLVE, "datset=town"), "unknown config key 'datset'; did you mean dataset?"),
    "a dataset misspelt": ((*SOLVE, "dataset=twon"), "dataset twon: no such folder; did you mean town?"),
    "a table of a dataset": (
        (*SOLVE, "dataset=town/drives.parquet"),
        "dataset town/drives.parquet: is a file; give its folder, town",
    ),
    "a folder of a dataset": (
        (*SOLVE, "dataset=town/imu"),
        "dataset town/imu: drives.parquet is missing; it lies in town",
    ),
    "a filter misspelt": ((*SOLVE, "model=pluss"), "unknown model 'pluss'; did you mean plus?"),
    "an imu's preset misspelt": (
        (*SOLVE, "imu=consumr"),
        "unknown preset or config 'imu/consumr'; did you mean consumer?",
    ),
    "out in the dataset": (
        (*SOLVE, "out=town/solved"),
        "out=town/solved lies in the dataset town; give a folder outside it",
    ),
    "out is the dataset": (
        (*SOLVE, "out=town", "overwrite=true"),
        "out=town is the dataset itself; give another folder",
    ),
    "out is a file": ((*SOLVE, "out=town/drives.parquet"), "out=town/drives.parquet lies in the dataset town"),
    "out below a file": ((*SOLVE, "out=town/drives.parquet/x"), "lies in the dataset town"),
    "out where nobody writes": ((*SOLVE, "out=/proc/made"), "out=/proc/made: cannot write there"),
    "an aid misspelt": ((*SOLVE, "aids=[sped]"), "aids: unknown 'sped'; known: speed, heading, baro"),
    "an aid that is not there": ((*SOLVE, "aids=[speed]"), "aids: no drive of town has speed/; leave it out"),
    "a rate of text": ((*SOLVE, "rate_hz=fast"), "rate_hz is 'fast', must be a number or null"),
    "a noise below 0": ((*SOLVE, "imu.accel.noise_density=-1"), "noise_density is -1.0, must be a finite number ≥ 0"),
    "a noise of text": ((*SOLVE, "imu.gyro.noise_density=low"), "gyro.noise_density is 'low', must be a number"),
    "a tuning below 0": ((*SOLVE, "tuning.velocity_std=-2"), "tuning: velocity_std is -2, must be above 0"),
    "a tuning that is none": (
        (*SOLVE, "tuning.velocty_std=2"),
        "unknown config key 'tuning.velocty_std'; did you mean tuning.velocity_std?",
    ),
    "an alignment below 0": ((*SOLVE, "align.speed=-3"), "unknown config key 'align.speed'"),
    "an outage below 0": ((*SCORE, "outage.duration_s=-3"), "outage.duration_s is -3, must be a number ≥ 0"),
    "an outage with its unit": ((*SCORE, "outage.duration_s=60s"), "outage.duration_s is '60s', must be a number"),
    "no length": ((*SCORE, "length_s=0"), "length_s=0 must be above 0 s"),
    "a step back": ((*SCORE, "stride_s=-1"), "stride_s=-1 must be above 0 s"),
    "a baseline misspelt": (
        (*SCORE, "baseline=mbkf51"),
        "baseline=mbkf51 is none of the models mbkf15; did you mean mbkf15?",
    ),
    "a mode misspelt": ((*SCORE, "mode=drive"), "mode=drive is none of auto, segments, drives"),
    "an equals sign too few": ((*SCORE, "overwrite"), "cannot read 'overwrite'; settings are key=value"),
    "a space round the equals sign": ((*SCORE, "seed", "=", "3"), "cannot read 'seed'; settings are key=value"),
    "a reader that is none": (
        ("ingest", "reader=atuo", "source=town", "out=made"),
        "unknown preset or config 'reader/atuo'; did you mean auto?",
    ),
    "a source of nowhere": (
        ("ingest", "reader=auto", "source=nowhere", "out=made"),
        "source=nowhere: no such file or folder",
    ),
    "a source that is missing": (("ingest", "reader=auto", "out=made"), "source is missing; give source=…"),
    "a dataset for logs": (("ingest", "reader=csv", "source=town", "out=made"), "town: is a dataset already"),
    "a car that is none": (
        ("simulate", "dataset=lifelik", "out=made"),
        "unknown preset or config 'simulated/lifelik'; did you mean lifelike?",
    ),
    "hours in words": (
        ("simulate", "dataset=city", "dataset.hours=ten", "out=made"),
        "dataset.hours is 'ten', must be a number",
    ),
    "a rate below zero": (
        ("simulate", "dataset=city", "dataset.imu_rate_hz=-50", "out=made"),
        "imu_rate_hz is -50, must be from 10 to 2000",
    ),
    "an experiment misspelt": (
        ("train", "+experiment=outag"),
        "unknown preset or config 'experiment/outag'; did you mean outage?",
    ),
    "an experiment without its plus": (("train", "experiment=outage"), "a preset is chosen with a plus: +experiment=…"),
    "a British optimiser": (
        ("train", "optimiser.lr=1e-3"),
        "unknown config key 'optimiser.lr'; did you mean optimizer.lr?",
    ),
    "a rate that learns backwards": (
        ("train", "data.datasets=[town]", "optimizer.lr=-1"),
        "optimizer: lr is -1, must be from 0 to 1000",
    ),
    "no epochs": (
        ("train", "data.datasets=[town]", "trainer.max_epochs=0"),
        "trainer: max_epochs is 0, must be from 1",
    ),
    "a folder that is no run": (("compare", "town", "town", "out=made"), "town is given twice"),
    "a drive that is none": (
        ("doctor", "dataset=town", "drives=[monday]"),
        "dataset town: no drive monday; has town-3-00000",
    ),
    "a command misspelt": (("__main__", "navigat", "dataset=town"), "unknown command 'navigat'; did you mean navi"),
    "a bare word": ((*SOLVE, "town"), "cannot read 'town'; settings are key=value"),
    "dashes": ((*SOLVE, "--dataset=town"), "unrecognized arguments: --dataset=town; settings are key=value"),
    "two models": ((*SCORE, "model=mbkf15,ins"), "several values are 'model=[mbkf15,ins]' as a list, or -m model="),
    "a length for a preset": ((*SCORE, "outage=60"), "a length in seconds is outage.duration_s=60"),
    "half a key": ((*SCORE, "outage.duration=60"), "did you mean outage.duration_s?"),
    "three lengths": ((*SCORE, "outage.duration_s=[10,20,30]"), "for a run each -m outage.duration_s=10,20,30"),
    "lengths the wrong way": ((*SCORE, "outage.duration_s=[60,30]"), "must be a number ≥ 0 or [low, high]"),
    "no imu": ((*SOLVE, "imu=null"), "imu=null: must be the name of a preset: adis16465_i2nav"),
    "an imu of a number": ((*SOLVE, "imu=5"), "imu=5: must be the name of a preset"),
    "two imus": ((*SOLVE, "imu=[consumer,bmi270]"), "one preset at a time; -m imu=consumer,bmi270 runs one after"),
    "no tuning": ((*SOLVE, "tuning=null"), "tuning=null: must be the name of a preset: any_car, gradient, untuned"),
    "exports, yes": ((*SOLVE, "export=true"), "export=True: must be a format or a list of formats"),
    "aids, no": ((*SOLVE, "aids=false"), "aids is False, must be a list such as [speed], [] for none"),
    "two datasets": ((*SOLVE, "dataset=[town,other]"), "one at a time, or -m dataset=town,other for a run each"),
    "no dataset": ((*SOLVE, "dataset="), "dataset= is empty; give a folder"),
    "a folder of a number": ((*SOLVE, "out=5"), "out is 5, must be a word; as a name: \"out='5'\""),
    "no model": ((*SOLVE, "model="), "model= is empty; give a name such as plus, or a folder"),
    "the network of the paper": ((*SOLVE, "model=dlkf"), "model=dlkf: this network has no weights here"),
    "a model's folder of nowhere": ((*SOLVE, "model=outputs/x/best"), "model=outputs/x/best: no such folder"),
    "a model in capitals": ((*SOLVE, "model=MBKF15"), "unknown model 'MBKF15'; did you mean mbkf15?"),
    "a folder of presets that is not there": (
        ("navigate", "dataset=town", "--config-dir", "nowhere", "model=ins"),
        "nowhere' not found",
    ),
    "a file among folders": (("compare", "town/drives.parquet", "town", "out=made"), "no metrics.json; give folders"),
    "a part that ends before it begins": (
        ("allan", "dataset=town", "drive=town-3-00000", "from_s=50", "to_s=10", "out=made"),
        "to_s=10 is not after from_s=50",
    ),
    "a car with other wheels": (
        ("consistency", "model=mbkf15", "out=made", "vehicle={wheels: 3}"),
        "vehicle: has no such key; one that its settings take is added as +vehicle.<key>=…",
    ),
    "a reader's file that is not there": (
        ("ingest", "reader=ubx", "source=town/drives.parquet", "out=made"),
        "no imu file *.ubx; has drives.parquet",
    ),
    "an aid that is none": ((*SOLVE, "aids=none"), "aids: unknown 'none'; known: speed, heading, baro"),
    "a smoother, yes": ((*SOLVE, "smoother=true"), "smoother is True, must be a word or null"),
    "drives of a number": ((*SOLVE, "drives=0"), "drives is 0, must be a name or a list of names"),
    "shares that are too much": (
        ("tune", "model=mbkf15", "dataset=town", "out=made", "fractions=[1,1,1]"),
        "must be three numbers ≥ 0 for train, val and test with sum 1",
    ),
    "a port of letters": (("ui", "port=abc"), "port=abc: must be a number"),
    "half a precision": (("export", "model=mbkf15", "out=made", "precision=half"), "must be one of double, float"),
    "an error without its number": ((*SCORE, "injected_bias=0"), "injected_bias is 0, must be a mapping or null"),
}


def test_there_are_two_hundred() -> None:
    assert len(BAD_FRAMES) + len(CALLS) + len(COMMANDS) >= 200


@pytest.mark.parametrize("case", COMMANDS)
def test_a_command(case: str, simulated: Path, call, tmp_path: Path) -> None:
    words, said = COMMANDS[case]
    shutil.copytree(simulated, tmp_path / "town")
    ended = call(*words)
    is_refused(ended, said, folder=tmp_path)
    assert said, ended.err
