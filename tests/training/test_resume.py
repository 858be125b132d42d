"""Killed at any moment and started again, training ends with the same weights as if nothing had happened."""

import os
import re
import signal
import time
from contextlib import nullcontext
from importlib import import_module

import pytest
import torch
from safetensors.torch import load_file

from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.command.composing import compose_command, configuration_hash
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.masks import Outage
from dlkf.filters.saved import parse_learned_settings
from dlkf.training.fit import check_fit, fit
from dlkf.training.module import FilterTraining
from dlkf.training.run_folder import check_digests, finished_before, hold_folder, read_state, run_folder, write_state
from dlkf.training.settings import FitSettings, TrainSettings, drop_unused
from dlkf.training.study import list_seen_recordings, model_card
from tests.shell import PATIENCE_S, start_fork


def data(dataset) -> DriveDataModule:
    return DriveDataModule(
        [dataset],
        batch_size=9,
        length_s=12.0,
        eval_length_s=18.0,
        fractions=(0.6, 0.2, 0.2),
        eval_outage=Outage(8.0, 6.0),
    )


def settings(**trainer) -> dict:
    train = compose_command("train", "seed=3")
    callbacks = train["callbacks"]
    callbacks["curriculum"] |= {"warm_s": 8.0, "full_s": 12.0, "warm_until": 1, "full_from": 3}
    callbacks["outage"] |= {"duration_s": [2.0, 4.0], "before_s": 4.0, "start_epoch": 2}
    train["trainer"] |= {"max_epochs": 4, "validate_every": 2, "best_from_epoch": 0, "accelerator": "cpu", **trainer}
    train["scheduler"]["restart_epochs"] = 3
    train["model"]["network"] |= {"lstm_hidden": 16, "lstm_layers": 2, "dense": [16, 8]}
    return train


def fit_of(values: dict) -> FitSettings:
    return settings_from(TrainSettings, values, "").fit


def make_settings(**trainer) -> FitSettings:
    return fit_of(settings(**trainer))


def weights(folder) -> dict:
    return torch.load(folder / "last.ckpt", weights_only=True)["state_dict"]


@pytest.mark.whole
def test_kill_minus_nine_changes_nothing(dataset, tmp_path):
    """A real SIGKILL in the middle of an epoch against an uninterrupted run: equal bit by bit."""
    fit(make_settings(), data(dataset), tmp_path / "whole", False)
    folder, step = tmp_path / "killed", FilterTraining.training_step

    def dies():
        def dying(self, batch, index):
            if self.global_step >= 5:
                os.kill(os.getpid(), signal.SIGKILL)
            return step(self, batch, index)

        FilterTraining.training_step = dying
        fit(make_settings(), data(dataset), folder, False)

    process = start_fork(tmp_path, tmp_path / "said", dies)
    process.join(PATIENCE_S)
    assert process.exitcode == -signal.SIGKILL, (tmp_path / "said").read_text()
    fit(make_settings(), data(dataset), folder, False)
    one, other = weights(tmp_path / "whole"), weights(folder)
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    best = [load_file(f / "best" / "weights.safetensors") for f in (tmp_path / "whole", folder)]
    assert all(torch.equal(best[0][k], best[1][k]) for k in best[0])


@pytest.mark.whole
def test_training_moves_towards_the_reference(dataset, tmp_path):
    """The loss falls on a tiny network in a few epochs."""
    from dlkf.filters.integration import integrate
    from dlkf.filters.learned import LearnedConfig, LearnedFilter
    from dlkf.filters.saved import load_filter
    from dlkf.training.loss import LossConfig, pva_losses

    torch.manual_seed(3)
    before = LearnedFilter(LearnedConfig.from_mapping(settings()["model"])).eval()
    longer = settings(max_epochs=5, validate_every=5)
    longer["optimizer"]["lr"] = 2e-2
    after = load_filter(fit(fit_of(longer), data(dataset), tmp_path / "run", False))
    batch = data(dataset).batches("test")[0]

    def loss(model):
        with torch.inference_mode():
            return float(pva_losses(integrate(batch, model), batch, LossConfig())["position"])

    assert loss(after) < 0.9 * loss(before)


@pytest.mark.whole
def test_without_outages_the_loss_chooses_the_weights(dataset, tmp_path):
    """No outage in validation: every better epoch is kept by val/loss, not the first one for ever."""
    plain = DriveDataModule([dataset], batch_size=9, length_s=12.0, eval_length_s=18.0, fractions=(0.6, 0.2, 0.2))
    chosen = settings(max_epochs=3, validate_every=1)
    best = fit(fit_of(chosen), plain, tmp_path / "run", False)
    state = torch.load(tmp_path / "run" / "last.ckpt", weights_only=True)["callbacks"]
    kept = next(v for k, v in state.items() if k.startswith("BestWeights"))
    assert best.is_dir() and kept["epoch"] > 0 and 0 < kept["score"] < float("inf")


def test_an_unknown_monitor_is_said_clearly(dataset, tmp_path):
    with pytest.raises(InputError, match="val/colour is not logged; choose one of val/gain_std"):
        fit(make_settings(max_epochs=1, validate_every=1, monitor="val/colour"), data(dataset), tmp_path / "run", False)


@pytest.mark.whole
def test_other_data_than_the_unfinished_run_began_with_are_refused(dataset, tmp_path):
    digests = check_digests([str(dataset)], {}, {})
    assert check_digests([str(dataset)], {}, digests) == digests
    with pytest.raises(InputError, match="resume=false"):
        check_digests([str(dataset)], {}, {"data": {str(dataset): "0" * 32}})


def test_another_network_of_ones_own_than_the_unfinished_run_began_with_is_refused(tmp_path, monkeypatch):
    """The configuration names it and stays the same; its module, and what that imports, does not."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own_sizes.py").write_text("WIDTH = 4\n")
    (tmp_path / "own_gru.py").write_text("import own_sizes\n")
    config = {"model": {"network": {"_target_": "own_gru.Gru"}}, "loss": {"_target_": "torch.nn.L1Loss"}}
    import_module("own_gru")
    began = check_digests([], config, {})
    assert list(began["code"]) == ["own_gru.py", "own_sizes.py"] and check_digests([], config, began) == began
    (tmp_path / "own_sizes.py").write_text("WIDTH = 8\n")
    with pytest.raises(InputError, match=r"own_sizes.py is not what the unfinished run began with .* old code back"):
        check_digests([], config, began)


@pytest.mark.parametrize(("epochs", "every", "start", "some"), [(1, 1, 3, False), (4, 3, 3, False), (6, 3, 3, True)])
def test_epochs_of_which_none_is_validated_are_refused_before_any_work(epochs, every, start, some, dataset):
    """Of six the 3rd and the 6th are validated, the latter after three. The error says what would do."""
    plan = make_settings(max_epochs=epochs, validate_every=every, best_from_epoch=start)
    with nullcontext() if some else pytest.raises(InputError, match="no epoch would be validated") as refused:
        check_fit(plan, data(dataset))
    if refused is not None:
        (least,) = re.findall(r"max_epochs=(\d+) is the least", str(refused.value))
        check_fit(make_settings(max_epochs=int(least), validate_every=every, best_from_epoch=start), data(dataset))
        with pytest.raises(InputError):
            check_fit(
                make_settings(max_epochs=int(least) - 1, validate_every=every, best_from_epoch=start), data(dataset)
            )


def test_outages_that_no_training_segment_has_room_for_are_refused(dataset):
    """They would switch the training with outages off without a word; segments grow to 12 s."""
    long = settings()
    long["callbacks"]["outage"]["duration_s"] = [4.0, 20.0]
    with pytest.raises(InputError, match=r"4 s without GNSS, before_s=4 and after_s=5 do not fit into .* of 12 s"):
        check_fit(fit_of(long), data(dataset))
    long["callbacks"]["outage"]["duration_s"] = [3.0, 20.0]
    check_fit(fit_of(long), data(dataset))


def test_a_random_split_says_that_recordings_of_the_test_were_trained_on(dataset):
    """As ``dlkf evaluate`` says it of a model."""
    study = settings_from(TrainSettings, settings(), "").study
    assert list_seen_recordings(study, data(dataset)) == []
    shuffled = DriveDataModule([dataset], split="random", length_s=12.0, eval_length_s=18.0)
    (line,) = list_seen_recordings(study, shuffled)
    said = r"dlkf was trained or chosen on (\d+) of these \d+ recordings, so its errors are too small; data.split"
    assert re.match(said, line)


def test_settings_that_a_network_or_loss_of_ones_own_does_not_take_are_not_logged():
    """The presets of the paper's lie beside the class; neither parameters nor the model's config.yaml have them."""
    config = settings()
    assert drop_unused(config) == config
    config["loss"] |= {"_target_": "tests.training.test_loss.Late", "scale": 2.0}
    config["model"]["network"] |= {"_target_": "tests.filters.test_learned.Mean", "width": 8}
    logged = drop_unused(config)
    assert logged["loss"] == {"_target_": "tests.training.test_loss.Late", "scale": 2.0}
    assert not {"lstm_hidden", "dense"} & set(logged["model"]["network"]) and logged["model"]["network"]["width"] == 8
    assert "lstm_hidden" not in parse_learned_settings(config["model"]).as_dict()["network"]


def test_the_card_of_a_model_says_that_the_code_was_changed(dataset, monkeypatch):
    monkeypatch.setattr("dlkf.training.study.repository_commit", lambda: "0123456789+")
    study = settings_from(TrainSettings, settings(), "").study
    assert model_card(study, data(dataset), None)["commit"] == "0123456789+"


@pytest.mark.parametrize("name", ["state.json", "last.ckpt"])
@pytest.mark.parametrize("left", [0, 0.5, 0.99])
def test_a_damaged_file_of_an_unfinished_run_is_named(name, left, tmp_path):
    """As a full disk or a power cut leaves it; with resume=false the folder is not read."""
    folder, _ = run_folder("a", "0123", resume=True, root=tmp_path)
    write_state(folder, run_id="abc")
    torch.save({"state_dict": {"weight": torch.ones(999)}}, folder / "last.ckpt")
    assert run_folder("a", "0123", resume=True, root=tmp_path) == (folder, {"run_id": "abc"})
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(InputError, match=rf"{folder}/{name} is damaged; remove {folder} or give resume=false"):
        run_folder("a", "0123", resume=True, root=tmp_path)
    assert run_folder("a", "0123", resume=False, root=tmp_path)[0].name == "0123-2"


@pytest.mark.whole
def test_a_checkpoint_with_other_bytes_is_damaged(tmp_path):
    """Of the right length, as a disk that lost a block leaves it."""
    folder = tmp_path / "a" / "0123"
    folder.mkdir(parents=True)
    torch.save({"weight": torch.ones(9999)}, folder / "last.ckpt")
    with (folder / "last.ckpt").open("r+b") as file:
        file.seek(20000)
        file.write(bytes(512))
    with pytest.raises(InputError, match=r"last\.ckpt is damaged"):
        run_folder("a", "0123", resume=True, root=tmp_path)


@pytest.mark.whole
def test_of_two_processes_with_one_run_the_second_is_refused(tmp_path):
    """Until the first ends, even by SIGKILL."""

    def hold():
        with hold_folder(tmp_path / "run"):
            (tmp_path / "there").touch()
            signal.pause()

    process = start_fork(tmp_path, tmp_path / "said", hold)
    end = time.monotonic() + PATIENCE_S
    while not (tmp_path / "there").exists():
        assert process.is_alive() and time.monotonic() < end, (tmp_path / "said").read_text()
        time.sleep(0.01)
    with (
        pytest.raises(InputError, match=r"the same training is running in .*/run; wait"),
        hold_folder(tmp_path / "run"),
    ):
        pytest.fail("two in one folder")
    process.kill()
    process.join(PATIENCE_S)
    with hold_folder(tmp_path / "run"):
        pass


def test_run_folder_is_found_again_until_it_is_finished(tmp_path):
    config = {"name": "a", "resume": True, "seed": 1, "tracking": {"uri": None}}

    def found(**change):
        return run_folder("a", configuration_hash(config | change), resume=True, root=tmp_path)

    folder, state = found()
    assert state == {} and folder == tmp_path / "a" / configuration_hash(config)
    write_state(folder, run_id="abc")
    assert found(tracking={"uri": "http://server"}) == (folder, {"run_id": "abc"})
    assert run_folder("a", configuration_hash(config), resume=False, root=tmp_path)[0].name == folder.name + "-2"
    assert found(seed=2)[0] != folder
    write_state(folder, finished=True)
    assert read_state(folder) == {"run_id": "abc", "finished": True}
    assert found()[0].name == folder.name + "-2"


def test_the_finished_training_before_a_new_folder_is_found(tmp_path):
    """On the same data alone: other data make another training."""
    one, two, three = (tmp_path / name for name in ("0123", "0123-2", "0123-3"))
    assert finished_before(one, [], {}) is None
    write_state(one, run_id="abc")
    assert finished_before(two, [], {}) is None, "not finished"
    write_state(one, finished=True)
    assert finished_before(two, [], {}) == "abc" and finished_before(one, [], {}) is None, "one is no new folder"
    write_state(two, run_id="def", finished=True, data={"town": "0"})
    assert finished_before(three, [], {}) is None, "other data"
