"""Wrong arguments of all commands: exit code 2, one line on stderr that says what and where, nothing half-written."""

from __future__ import annotations

import pytest

from tests.commands.refusals import DRIVE, FAST, SCORED, SOLVED, TRAINED, is_refused


@pytest.mark.parametrize("command", FAST)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["model=mbkf15", "dataset=nowhere"], ("nowhere", "no such folder")),
        (["model=mbkf16", "dataset=town"], ("unknown model 'mbkf16'", "mbkf15")),
        (["model=mbkf15_prior", "dataset=town"], ("prior.mean",)),
        (["model=mbkf15", "dataset=town", "imu=best"], ("imu/best", "consumer")),
        (["model=mbkf15", "dataset=town", "speed=1"], ("unknown config key 'speed'",)),
        (["model=mbkf15", "dataset=town", "tuning.fun=2"], ("unknown config key 'tuning.fun'",)),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=-1"], ("noise_density", "-1")),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=low"], ("noise_density", "'low'")),
        (["model=mbkf15", "dataset=town", "rate_hz=0"], ("rate_hz",)),
        (["model=mbkf15", "dataset=town", "drives=[nobody]"], ("nobody",)),
        (["model=mbkf15", "dataset=town", "drives=[]"], ("drives", "null")),
        (["model=mbkf15", "dataset=town", "drives=[car-00,car-00]"], ("car-00", "twice")),
        (["model=mbkf15", "dataset"], ("dataset",)),
        (["model=mbkf15"], ("dataset is missing",)),
    ],
    ids=lambda x: " ".join(x),
)
def test_wrong_arguments(command, arguments, said, copy, call, tmp_path):
    done = call(command, *arguments, "out=made")
    is_refused(done, *said, folder=tmp_path)


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("evaluate", ["dataset=town", "out=made"], "model is missing"),
        ("simulate", ["dataset=mars"], "simulated/mars"),
        ("simulate", ["dataset.hours=-1", "out=made"], "hours"),
        ("simulate", ["dataset.vehicle.colour=red", "out=made"], "dataset.vehicle.colour"),
        ("simulate", ["out=town"], "exists already"),
        ("ingest", ["source=nowhere", "out=made"], "nowhere"),
        ("ingest", ["reader=tape", "source=town", "out=made"], "reader/tape"),
    ],
)
def test_of_making_data(command, arguments, said, copy, call, tmp_path):
    is_refused(call(command, *arguments), said, folder=tmp_path)


NOWHERE = "tracking.uri=sqlite:///nowhere.db"


OF_ALL_COMMANDS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "a word for a seed": ("evaluate", (*SCORED, "seed=abc"), "seed is 'abc', must be a whole number"),
    "a seed below zero": ("evaluate", (*SCORED, "seed=-1"), "seed is -1, must be a whole number ≥ 0"),
    "roads of a seed below zero": ("simulate", ("seed=-3", "out=made"), "seed is -3"),
    "a test of a seed below zero": ("train", (*TRAINED, "scoring.seed=-3"), "scoring.seed is -3"),
    "a score before the start": ("evaluate", (*SCORED, "settle_s=-5"), "settle_s is -5, must be 0 or more"),
    "a test before the start": (
        "train",
        (*TRAINED, "scoring.settle_s=-5"),
        "scoring.settle_s is -5, must be 0 or more",
    ),
    "a consistency before the start": (
        "consistency",
        ("model=mbkf15", "out=made", "settle_s=-5"),
        "settle_s is -5, must",
    ),
    "a strategy that is none": (
        "train",
        (*TRAINED, "trainer.devices=2", "trainer.strategy=fsdp"),
        "trainer.strategy is 'fsdp', must be",
    ),
    "a key too many": ("evaluate", (*SCORED, "+colour=red"), "unknown config key 'colour'"),
    "a key too many in a section": ("navigate", (*SOLVED, "+align.colour=red"), "align: unknown key colour"),
    "a key too many beside the store": ("navigate", (*SOLVED, "+tracking.colour=red"), "tracking: unknown key colour"),
    "a key too many of a training": ("train", (*TRAINED, "++colour=red"), "unknown config key 'colour'"),
    "a key too many of the data": ("train", (*TRAINED, "+data.colour=red"), "takes no colour"),
    "a preset that the command does not take": ("ingest", ("+tuning=untuned", "source=x", "out=made"), "key 'tuning'"),
    "a word for a length": ("evaluate", (*SCORED, "length_s=long"), "length_s is 'long', must be a number"),
    "a word for a switch": ("evaluate", (*SCORED, "overwrite=maybe"), "overwrite is 'maybe', must be true or false"),
    "a baseline that nobody knows": ("evaluate", (*SCORED, "baseline=foo"), "baseline=foo is none of the models"),
    "a reference that nobody knows": ("evaluate", (*SCORED, "reference=best"), "reference=best is none of file"),
    "an outage of a word": ("evaluate", (*SCORED, "outage.first_s=soon"), "outage.first_s is 'soon'"),
    "a folder as store": ("evaluate", (*SCORED, "tracking.uri=runs"), "is a plain folder"),
    "a segment longer than the drives": (
        "evaluate",
        (*SCORED, "mode=segments", "length_s=1e4"),
        "no segment of 10000 s",
    ),
    "an outage longer than a segment": ("evaluate", (*SCORED, "length_s=30"), "after 40 s but segments are 30 s"),
    "an outage after the end": (
        "evaluate",
        (*SCORED, "mode=drives", "outage.first_s=900", "outage.duration_s=20"),
        "no outage fits into these drives: outage.first_s=900",
    ),
    "a drive that is not there": ("evaluate", (*SCORED, "drives=nobody"), "no drive nobody"),
    "an export that nobody knows": ("navigate", (*SOLVED, "export=[kml,shp]"), "export=shp: unknown format"),
    "a clock that nobody knows": ("navigate", (*SOLVED, "export_clock=tai"), "export_clock=tai is none of auto"),
    "several models to navigate": ("navigate", (*SOLVED, "model=[ins,mbkf15]"), "one model at a time"),
    "a smoother in a stream": ("navigate", (*SOLVED, "smoother=rts", "streaming=true"), "smoother or streaming"),
    "a smoother of ins": ("navigate", ("model=ins", *SOLVED[1:], "smoother=rts"), "needs a filter with a covariance"),
    "an epoch of no whole samples": ("navigate", (*SOLVED, "epoch_s=0.33"), "whole number of samples"),
    "an unknown alias": ("navigate", ("model=models:/town@champion", *SOLVED[1:], NOWHERE), "no MLflow store"),
    "an alias that MLflow refuses": ("train", (*TRAINED, "tracking.alias=latest"), "neither latest nor v<number>"),
    "a name that MLflow refuses": ("train", (*TRAINED, "tracking.register=a/b"), "has none of / : @"),
    "a rate of letters": ("train", (*TRAINED, "optimizer.lr=fast"), "optimizer.lr is 'fast', must be a number"),
    "no data to train on": ("train", ("data=drives", "data.datasets=[nowhere]"), "no such folder"),
    "too few recordings": ("train", TRAINED, "group"),
    "a batch of nothing": ("train", (*TRAINED, "data.batch_size=0"), "batch_size"),
    "a filter without noise": ("tune", ("model=ins", "dataset=town", "out=made"), "no noise to tune"),
    "an objective that nobody knows": ("tune", ("model=mbkf15", "dataset=town", "out=made", "objective=q"), "none of"),
    "a name that is no file's": ("tune", ("model=mbkf15", "dataset=town", "out=made", "name=a/b"), "letters, digits"),
    "no run to register": ("register", ("run=" + "0" * 32, "name=town", NOWHERE), "no MLflow store"),
    "no name to register": ("register", ("run=" + "0" * 32,), "name is missing"),
    "one report alone": ("compare", ("runs=[town]", "out=made"), "at least two"),
    "no report at all": ("compare", ("town", "logs", "out=made"), "no metrics.json"),
    "a doctor without a patient": ("doctor", ("dataset=nowhere",), "no such folder"),
    "a moving bench": ("allan", ("dataset=town", "out=made", f"drive={DRIVE}"), DRIVE),
    "an allan of nobody": ("allan", ("dataset=town", "out=made", "drive=nobody"), "nobody"),
    "a consistency of nothing": ("consistency", ("model=[]", "out=made"), "empty list"),
    "a consistency without noise": ("consistency", ("model=ins", "out=made"), "ins"),
    "a simulation of nothing": ("simulate", ("dataset.hours=0", "out=made"), "hours"),
    "an export of nobody": ("export", ("model=mbkf99", "out=made"), "unknown model 'mbkf99'"),
    "an export that looks ahead": ("export", ("model=mbkf21_rts", "out=made"), "looks ahead"),
    "an export of several": ("export", ("model=[ins,mbkf15]", "out=made"), "unknown model"),
    "an export without a rate": ("export", ("model=mbkf15", "out=made", "rate_hz=0"), "rate_hz is 0, must be above 0"),
    "an export at a rate mistyped": (
        "export",
        ("model=mbkf15", "out=made", "rate_hz=1e9"),
        "rate_hz is 1000000000.0, must be above 0 and at most 10000",
    ),
    "an epoch of a day": ("navigate", (*SOLVED, "epoch_s=86400"), "epoch_s is 86400, must be above 0 and at most 60"),
    "a home of nobody": ("navigate", (*SOLVED[:2], "out=~nobody-here/x"), "no user nobody-here here; for a folder of"),
    "data of nobody": ("evaluate", (*SCORED, "dataset=[~nobody-here/x]"), "there is no user nobody-here here"),
    "a comparison of nobody": ("compare", ("~nobody-here/a", "town", "out=made"), "there is no user nobody-here here"),
    "an export back in time": ("export", ("model=mbkf15", "out=made", "epoch_s=-1"), "epoch_s is -1, must be above 0"),
    "an export of a third": ("export", ("model=mbkf15", "out=made", "epoch_s=0.33"), "whole number of samples"),
    "an export checked nowhere": ("export", ("model=mbkf15", "out=made", "dataset=nowhere"), "no such folder"),
    "an export checked on nobody": (
        "export",
        ("model=mbkf15", "out=made", "dataset=town", "drive=nobody"),
        "no drive nobody",
    ),
    "an export over data": ("export", ("model=mbkf15", "out=town"), "out=town exists already"),
    "an export into nothing": ("export", ("model=mbkf15", "out="), "out= is empty; give a folder"),
    "tuned into nothing": ("tune", ("model=mbkf15", "dataset=town", "out="), "out= is empty; give a folder"),
    "tuned into a store": ("tune", ("model=mbkf15", "dataset=town", "out=memory://x"), "folders of this machine alone"),
    "a solution of nothing": ("navigate", (*SOLVED[:2], "out="), "out= is empty; give a folder"),
    "a simulation here": ("simulate", ("out=.", "overwrite=true"), "out=. would replace the current folder"),
    "a simulation above": ("simulate", ("out=..", "overwrite=true"), "would replace the current folder"),
    "a simulation into nothing": ("simulate", ("out=", "overwrite=true"), "would replace the current folder"),
    "an export of a word": ("export", ("model=mbkf15", "out=made", "latency=maybe"), "latency is 'maybe'"),
    "compiled, perhaps": ("navigate", (*SOLVED, "compiled=maybe"), "compiled is 'maybe', must be true or false"),
    "compiled and smoothed": ("navigate", (*SOLVED, "compiled=true", "smoother=rts"), "leave compiled=true out"),
    "compiled smoother": ("navigate", ("model=mbkf15_rts", *SOLVED[1:], "compiled=true"), "leave compiled=true out"),
    "noise of a network": ("navigate", ("model=plus", "dataset=town", "out=made", "imu=auto"), "takes none"),
    "noise of no filter": (
        "tune",
        ("model=plus", "dataset=town", "out=made", "objective=likelihood"),
        "no noise to tune",
    ),
    "noise in no time": (
        "tune",
        ("model=mbkf21", "dataset=town", "out=made", "objective=likelihood", "minutes=0"),
        "minutes is 0",
    ),
    "factors in no rounds": ("tune", ("model=mbkf21", "dataset=town", "out=made", "rounds=0"), "rounds is 0, must be"),
    "factors of no segments": (
        "tune",
        ("model=mbkf21", "dataset=town", "out=made", "segments=-2"),
        "segments is -2, must",
    ),
    "a consistency of no drives": ("consistency", ("model=mbkf15", "out=made", "drives=0"), "drives is 0, must be"),
    "a consistency of no time": ("consistency", ("model=mbkf15", "out=made", "minutes=-1"), "minutes is -1, must be"),
    "noise in few minutes": (
        "tune",
        ("model=mbkf21", "dataset=town", "out=made", "objective=likelihood", "minutes=few"),
        "minutes is 'few'",
    ),
    "an option that nobody knows": ("evaluate", (*SCORED, "--quick"), "unrecognized arguments: --quick"),
    "a page that nobody knows": ("navigate", (*SOLVED, "--cfg", "all_of_it"), "--cfg/-c: invalid choice"),
    "a store that nobody knows": ("evaluate", (*SCORED, "tracking.uri=ftp://x"), "no kind of MLflow store"),
    "a comparison of a number": ("compare", ("runs=5", "out=made"), "at least two"),
    "a test longer than its segments": (
        "train",
        (*TRAINED, "data.eval_length_s=60"),
        "after 75 s but segments are 60 s long; give a larger data.eval_length_s",
    ),
    "a split that nobody knows": ("tune", ("model=mbkf15", "dataset=town", "out=made", "split=foo"), "split=foo"),
    "workers that nobody knows": ("simulate", ("out=made", "parallel=grid"), "must be a number of processes"),
    "a model of a number": ("evaluate", (*SCORED, "model=5"), "model is 5, must be a name or a list"),
    "a patient of a number": ("doctor", ("dataset=town", "drives=5"), "drives is 5, must be a name or a list"),
    "an experiment of several, one unknown": ("train", ("+experiment=[outage,nope]",), "'experiment/nope'"),
    "a callback of a number": ("train", (*TRAINED, "callbacks.guard=5"), "callbacks.guard has no _target_"),
    "weights from nowhere": ("train", (*TRAINED, "finetune=nowhere"), "nowhere"),
    "a baseline of nobody": ("train", (*TRAINED, "baselines.models=[mbkf99]"), "unknown filter 'mbkf99'"),
    "a lever arm of one number": ("ingest", ("reader.lever_arm_m=0.5", "source=logs", "out=made"), "lever_arm_m"),
}


@pytest.mark.parametrize("name", OF_ALL_COMMANDS)
def test_of_all_commands(name, copy, call, tmp_path):
    command, arguments, said = OF_ALL_COMMANDS[name]
    (tmp_path / "logs").mkdir()
    is_refused(call(command, *arguments), said, folder=tmp_path)
