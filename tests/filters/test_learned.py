"""The literal DLKF: structure of the paper, memory, modes, gradient, saving."""

from dataclasses import replace

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from dlkf.base.errors import InputError
from dlkf.filters.integration import integrate
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import load_filter, save_filter

from .scene import scene

SMALL = {"network": {"lstm_hidden": 16, "lstm_layers": 2, "dense": [24, 12]}}


def small(**settings) -> LearnedFilter:
    torch.manual_seed(0)
    return LearnedFilter(LearnedConfig.from_mapping({**SMALL, **settings})).eval()


def lively(model: LearnedFilter) -> LearnedFilter:
    """Heads with weights of some size, so that differences show."""
    with torch.no_grad():
        model.gain.linear.weight.mul_(20)
        model.imu_error.linear.weight.mul_(50)
    return model


def single(batch):
    return batch.in_precision(torch.float32)


def test_the_paper_s_network_has_its_2_2_million_parameters():
    """Layer by layer as in paper.md 4.1: CNN, LSTM 4 × 256 on 80 inputs, dense 512 and 256, heads 54 + 6."""
    model = LearnedFilter(LearnedConfig())
    cnn = (15 * 32 * 3 + 32) + (32 * 3 + 1)
    lstm = 4 * 256 * (80 + 256 + 2) + 3 * 4 * 256 * (256 + 256 + 2)
    dense = (256 * 512 + 512) + (512 * 256 + 256)
    heads = 257 * 60
    assert sum(p.numel() for p in model.parameters()) == cnn + lstm + dense + heads == 2205021


def test_untrained_it_is_a_usable_filter():
    """Gain ½ on position and velocity, no IMU error: it follows the fixes."""
    batch = single(scene(8, 40, seed=1, bias=torch.zeros(8, 6, dtype=torch.float64)))
    solution = integrate(batch, small())
    assert (solution.posterior.p_n - batch.truth.p_n)[:, 10:].norm(dim=-1).mean() < 2.0
    gain = solution.gain[:, -1]
    assert torch.allclose(gain[:, :6], 0.5 * torch.eye(6).expand(8, 6, 6), atol=0.05)


def test_hold_keeps_the_imu_error_between_fixes_and_run_does_not():
    batch = single(scene(4, 30, seed=2))
    available = batch.available.clone()
    available[:, 10:20] = False
    batch = replace(batch, available=available)
    held = integrate(batch, lively(small(outage_mode="hold"))).imu_error
    assert (held[:, 9:20] == held[:, 9:10]).all()
    ran = integrate(batch, lively(small(outage_mode="run")))
    assert (ran.imu_error[:, 10:20].diff(dim=1).abs().amax((1, 2)) > 0).all()
    assert torch.equal(ran.prior.p_n[:, 10:20], ran.posterior.p_n[:, 10:20])


@pytest.mark.parametrize("limit", [0.05, 0.0])
def test_an_attitude_correction_is_limited_in_training_alone(limit):
    batch = single(scene(3, 2, seed=4))
    model = small(training_turn=limit, outage_mode="run")
    with torch.no_grad():
        model.gain.linear.bias[36:].fill_(10.0)  # rows of the attitude: degrees for a metre
    turns = []
    for mode in (True, False):
        first = integrate(batch, model.train(mode))
        between = first.posterior.C_nb[:, 0] @ first.prior.C_nb[:, 0].mT
        turns.append(torch.rad2deg(((between.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()))
    assert (turns[1] > 3.0).all()
    assert torch.allclose(turns[0], torch.full((3,), 2.865), atol=0.01) if limit else torch.allclose(*turns, rtol=0.01)


def test_segments_of_a_batch_do_not_touch_each_other():
    """Different fixes are missing in each segment; alone or together, the solution is the same."""
    batch = single(scene(5, 25, seed=3))
    g = torch.Generator().manual_seed(0)
    batch = replace(batch, available=torch.rand(5, 25, generator=g) < 0.4)
    for mode in ("hold", "run"):
        model = lively(small(outage_mode=mode))
        together = integrate(batch, model)
        for i in range(5):
            alone = integrate(batch.select(torch.tensor([i])).trim(), model)
            assert (alone.posterior.p_n[0] - together.posterior.p_n[i]).abs().max() < 2e-3
            assert (alone.imu_error[0] - together.imu_error[i]).abs().max() < 1e-5


def test_heading_frame_does_not_see_the_direction_of_driving():
    """The same drive turned by 90° about the vertical gives the same solution, turned (paper.md 4.9).

    Earth rotation off, or turning would change the physics.
    """
    batch = scene(3, 25, seed=4)
    off = replace(batch.frame, earth_rate_n=torch.zeros_like(batch.frame.earth_rate_n))
    zero_tilt = replace(off, stretch=torch.ones_like(off.stretch))
    batch = replace(batch, frame=zero_tilt)
    Z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)

    def turned(state):
        return type(state)(state.p_n @ Z.T, state.v_n @ Z.T, Z @ state.C_nb)

    gnss = torch.cat((batch.gnss[..., :3] @ Z.T, batch.gnss[..., 3:] @ Z.T), -1)
    rotated = replace(batch, start=turned(batch.start), truth=turned(batch.truth), gnss=gnss)
    model = lively(small(frame="heading")).double()
    a, b = integrate(batch, model), integrate(rotated, model)
    assert (turned(a.posterior).p_n - b.posterior.p_n).abs().max() < 1e-3
    blind = lively(small(frame="ned")).double()
    a, b = integrate(batch, blind), integrate(rotated, blind)
    assert (turned(a.posterior).p_n - b.posterior.p_n).abs().max() > 0.05


@pytest.mark.parametrize(
    "network",
    [{"fusion": "strict30"}, {"cell": "gru"}, {"cell": "none"}, {"window": False}, {"init": "responsive"}],
    ids=str,
)
def test_gradient_reaches_every_parameter(network):
    """In the paper's network and in its relatives (R052)."""
    batch = single(scene(3, 12, seed=5))
    model = small(network={**SMALL["network"], **network, "dropout": 0.0}).train()
    solution = integrate(batch, model)
    ((solution.prior.p_n - batch.truth.p_n) ** 2).mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.any(), name


@pytest.mark.whole
def test_gradient_of_the_whole_loop_agrees_with_finite_differences():
    """End to end through strapdown, feedback and network; features attached, as detaching would break it."""
    batch = scene(1, 4, seed=6)
    model = lively(small(detach_features=False)).double()
    weight = model.imu_error.linear.bias

    def loss(values):
        with torch.no_grad():
            weight.copy_(values)
        solution = integrate(batch, model)
        return ((solution.posterior.p_n - batch.truth.p_n) ** 2).sum() + (solution.posterior.v_n**2).sum()

    base = weight.detach().clone()
    value = loss(base)
    (gradient,) = torch.autograd.grad(value, weight)
    for i in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[i] = 1e-4
        numeric = float(loss(base + step).detach() - loss(base - step).detach()) / 2e-4
        # the last correction and the past posterior enter the features detached: a small part is missing
        assert abs(numeric - float(gradient[i])) < 0.05 * max(abs(numeric), float(gradient.abs().max()) * 0.1), i


def test_an_affine_error_takes_off_what_a_sensor_matrix_puts_on():
    """M of both sensors by the head's bias alone: the window's samples come out as if there were none."""
    model = small(imu_error="affine", outage_mode="run")
    M = 0.02 * torch.tensor([[[1.0, -0.5, 0.2], [0.0, -1.0, 0.3], [0.4, 0.0, 0.5]]] * 2)
    with torch.no_grad():
        model.imu_error.linear.weight.zero_()
        model.imu_error.linear.bias[6:] = (M / 0.01).flatten()
    batch = scene(2, 4, seed=8, noise=False, bias=torch.zeros(2, 6, dtype=torch.float64))
    force, rate = batch.imu[..., :3], batch.imu[..., 3:]
    wrong = torch.cat((force @ (torch.eye(3) + M[0]).double().T, rate @ (torch.eye(3) + M[1]).double().T), -1)
    solution = integrate(single(replace(batch, imu=wrong)), model)
    from_second = (wrong - batch.imu).mean(2)[:, 1:]  # nothing is known in the first epoch
    assert torch.allclose(solution.imu_error[:, 1:].double(), from_second, atol=2e-4)


def test_features_take_the_sizes_of_training_segments_and_keep_them(tmp_path):
    """After learning sizes every input is of size one; the sizes are stored with the weights."""
    batches = [single(scene(20, 30, seed=9))]
    model = small(frame="heading", outage_mode="run")
    model.learn_sizes(batches)
    with model.record_inputs() as seen, torch.inference_mode():
        integrate(batches[0], model)
    scaled = model.scaling(*(torch.cat(x) for x in zip(*seen)))
    spread = scaled[1].std(0)
    assert ((spread > 0.3) & (spread < 3.0)).all(), spread
    save_filter(model, tmp_path / "model")
    again = load_filter(tmp_path / "model")
    assert torch.equal(again.scaling.component_size, model.scaling.component_size)


def test_a_mean_error_is_where_the_imu_error_starts():
    model = small(imu_error_bound=5.0)
    mean = [0.1, -0.2, 0.05, 3e-3, -1e-3, 5e-3]
    model.imu_error.start_at(mean)
    with torch.no_grad():
        model.imu_error.linear.weight.zero_()
    error = model.imu_error(torch.randn(2, 12)).bias
    assert torch.allclose(error, torch.tensor([mean] * 2), rtol=1e-4)


def test_a_trained_network_answers_a_parked_car_otherwise_than_a_turning_one():
    """Ten steps of training on turning cars: the gain depends on what the car does, and on its fixes. A network that
    is a constant would pass every test of accuracy after a cold start."""
    network = {**SMALL["network"], "init": "responsive", "dropout": 0.0}
    model = small(frame="heading", outage_mode="run", network=network)
    batch = single(scene(16, 20, seed=10))
    model.learn_sizes([batch])
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    for _ in range(10):
        solution = integrate(batch, model.train())
        error = solution.prior.error_to(batch.truth)[:, 5:]
        loss = (error / torch.tensor([1.0] * 3 + [0.1] * 3 + [0.02] * 3)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    model.eval()
    parked = torch.zeros_like(batch.imu)
    parked[..., 2] = -9.8124
    still = replace(batch, imu=parked, start=batch.start._replace(v_n=torch.zeros_like(batch.start.v_n)))
    still = replace(still, gnss=torch.cat((batch.start.p_n[:, None].expand(-1, 20, -1), torch.zeros(16, 20, 3)), -1))
    with torch.inference_mode():
        turning, standing = (integrate(b, model).gain[:, 10:] / model.gain.scale for b in (batch, still))
    apart = (turning.mean((0, 1)) - standing.mean((0, 1))).abs()
    assert apart.max() > 0.02  # of the heads' sizes; the constant network of a plain start has 1e-5
    assert turning.std((0, 1)).square().mean().sqrt() > 5e-3


def test_saved_and_loaded_it_is_the_same_filter(tmp_path):
    model = lively(small(outage_mode="run", frame="heading"))
    save_filter(model, tmp_path / "model")
    again = load_filter(tmp_path / "model")
    assert again.config == model.config
    batch = single(scene(2, 10, seed=7))
    assert torch.equal(integrate(batch, model).posterior.p_n, integrate(batch, again).posterior.p_n)


def test_mistakes_in_a_model_folder_are_one_clear_line(tmp_path):
    def complaint(change) -> str:
        folder = tmp_path / "model"
        save_filter(small(), folder)
        change(folder)
        with pytest.raises(InputError) as error:
            load_filter(folder)
        assert "\n" not in str(error.value)
        return str(error.value)

    def other_width(folder):
        config = yaml.safe_load((folder / "config.yaml").read_text())
        config["network"]["lstm_hidden"] = 32
        (folder / "config.yaml").write_text(yaml.safe_dump(config))

    def unknown_key(folder):
        with (folder / "config.yaml").open("a") as f:
            f.write("colour: blue\n")

    def one_tensor_less(folder):
        weights = load_file(folder / "weights.safetensors")
        weights.pop("gain.linear.bias")
        save_file(weights, folder / "weights.safetensors")

    def pickled(folder):
        torch.save({"a": torch.zeros(1)}, folder / "weights.safetensors")

    assert "does not fit" in complaint(other_width)
    assert "colour" in complaint(unknown_key)
    assert "gain.linear.bias" in complaint(one_tensor_less)
    assert "pickle" in complaint(pickled)
    assert "no weights.safetensors" in complaint(lambda f: (f / "weights.safetensors").unlink())
    assert "no config.yaml" in complaint(lambda f: (f / "config.yaml").unlink())


class Mean(torch.nn.Module):
    """A network of one's own: one dense layer over the window's mean and the components, no memory."""

    def __init__(self, flags: int, width: int = 8):
        super().__init__()
        self.width = width
        self.layer = torch.nn.Linear(15 + 30 + flags, width)

    def start(self, batch_size, like):
        return ()

    def forward(self, window, components, memory):
        return torch.tanh(self.layer(torch.cat((window.mean(-1), components), -1))), ()


def test_a_network_of_one_s_own_runs_is_saved_and_loaded(tmp_path):
    target = f"{__name__}.Mean"
    network = {"_target_": target, "width": 6, "kernel": 3}
    config = LearnedConfig.from_mapping({"outage_mode": "run", "network": network})
    model = LearnedFilter(config).eval()
    assert model.network.layer.weight.shape == (6, 47)
    save_filter(model, tmp_path / "model")
    again = load_filter(tmp_path / "model")
    batch = single(scene(2, 10, seed=7))
    assert torch.equal(integrate(batch, model).posterior.p_n, integrate(batch, again).posterior.p_n)


@pytest.mark.parametrize(
    "network,words",
    [
        ({"_target_": "nowhere.Mean"}, "PYTHONPATH"),
        ({"_target_": f"{__name__}.Nothing"}, "Nothing"),
        ({"_target_": f"{__name__}.Mean", "colour": 3}, "takes no colour; it takes flags, width"),
        ({"_target_": "torch.nn.Identity"}, "has no start"),
    ],
)
def test_a_network_that_is_none_is_said_clearly(network, words):
    with pytest.raises(InputError, match=words):
        LearnedFilter(LearnedConfig.from_mapping({"network": network}))


@pytest.mark.parametrize(
    "settings,words",
    [
        ({"outage_mode": "sleep"}, "hold, run"),
        ({"frame": "ecef"}, "ned, heading"),
        ({"network": {"kernel": 4}}, "odd"),
        ({"network": {"dropout": 1.5}}, "dropout"),
        ({"network": {"samples": 20}}, "rate_hz"),
        ({"network": {"layers": 3}}, "lstm_layers"),
        ({"training_turn": -0.1}, "training_turn"),
    ],
)
def test_settings_that_make_no_sense(settings, words):
    with pytest.raises(InputError, match=words):
        LearnedConfig.from_mapping(settings)


def test_other_rate_than_trained_on_is_refused():
    with pytest.raises(InputError, match="rate_hz"):
        integrate(single(scene(1, 3)), small(rate_hz=100.0))


def test_times_are_counted_in_seconds():
    """Since the network last ran, and since the last fix, behind each epoch of a second."""
    batch = single(scene(2, 6))
    batch.available[0, 3:] = False
    seen = []

    class Watched(LearnedFilter):
        def step(self, memory, epoch):
            memory, correction = super().step(memory, epoch)
            seen.append((memory.elapsed.tolist(), memory.since_fix.tolist()))
            return memory, correction

    with torch.no_grad():
        integrate(batch, Watched(LearnedConfig.from_mapping(SMALL)).eval())
    assert seen == [([k, 0], [k, 0]) for k in (0, 0, 0, 1, 2, 3)]
