"""Errors of positions: how much of them is white, how fast the rest moves, and what noise a fix is given for it."""

import math
from dataclasses import replace

import torch

from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.plus import ANY_MEMS
from dlkf.filters.position_errors import PositionErrors
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec

from .scene import scene

STD, TAU = 2.0, 40.0  # m, s


class Watched:
    """A Kalman filter with the errors of its fixes beside it."""

    def __init__(self, speed=1.0):
        self.speed = speed  # of the true one
        self.kalman = build_filter("mbkf21", imu_spec(ANY_MEMS), tuning=Tuning(position_std=2.0))
        self.errors, self.variances, self.noises = [], [], []

    def begin(self, batch):
        memory, error = self.kalman.begin(batch)
        return (memory, PositionErrors.begin(batch.imu, batch.size[0])), error

    def step(self, memory, epoch):
        kalman, errors = memory
        errors, change = errors.advance(epoch, torch.zeros_like(epoch.z[:, 0]))
        self.variances.append(change.added + change.walk)
        self.noises.append(errors.noise(epoch, kalman.fix.scale[0, 0, 0]))
        kalman, correction = self.kalman.step(kalman, epoch)
        end = epoch.window.end
        window = epoch.window._replace(end=end._replace(v_n=self.speed * end.v_n))
        none = torch.zeros_like(epoch.z[:, :3])  # of the states that this filter lacks
        self.errors.append(errors.update(epoch._replace(window=window), correction.covariances, none, none))
        return (kalman, self.errors[-1]), correction


def watched(errors, available=None, speed=1.0, claim=STD):
    """Of cars whose positions have these errors (B, T, 3) and a claimed 1σ of 2 m."""
    batch = scene(*errors.shape[:2], seed=5, position_std=1e-3)
    gnss, std = batch.gnss.clone(), batch.gnss_std.clone()
    gnss[..., :3] += errors
    std[..., :3] = claim
    batch = replace(batch, gnss=gnss, gnss_std=std)
    run = Watched(speed)
    with torch.inference_mode():
        integrate(batch if available is None else replace(batch, available=available), run)
    return run


def test_white_errors_and_wandering_ones_are_told_apart():
    """Means of eight cars each after 150 fixes. White: w = 1, q = 0. Gauss-Markov: w = 0, q = 2 / τ. Each mean starts
    with 20 fixes of white noise, and 150 products of pairs scatter by a tenth of the white part. Horizontal
    and vertical errors have estimates of their own: cars 17 to 32 have one of each kind."""
    g, white = torch.Generator().manual_seed(3), torch.randn(8, 150, 3, generator=torch.Generator().manual_seed(1))
    slow, decay = torch.zeros(8, 150, 3), math.exp(-1 / TAU)
    now = torch.randn(8, 3, generator=g)
    for k in range(150):
        slow[:, k] = now = decay * now + math.sqrt(1 - decay**2) * torch.randn(8, 3, generator=g)
    down = torch.tensor([False, False, True])
    mixed = [torch.where(down, a, b) for a, b in ((slow, white), (white, slow))]
    run = watched(STD * torch.cat((white, slow, *mixed)).double())
    last, variance = run.errors[-1], run.variances[-1] / STD**2
    w, q = (x.unflatten(0, (4, 8)).mean(1) for x in (last.white, last.walk))
    moved = variance.unflatten(0, (4, 8)).mean(1)[:, [0, 2]]
    is_slow = torch.tensor([[False, False], [True, True], [False, True], [True, False]])
    assert (w[~is_slow] > 0.75).all() and (w[~is_slow] < 1.15).all() and (w[is_slow] < 0.15).all(), w
    assert (q[~is_slow].abs() < 0.1).all() and (q[is_slow] > 0.03).all() and (q[is_slow] < 0.1).all(), q
    assert (moved[~is_slow] < 0.025).all() and (moved[is_slow] > 0.02).all() and (moved[is_slow] < 0.1).all(), moved


def test_without_pairs_of_fixes_nothing_is_learned():
    """A fix every other second: all of its error is white."""
    available = (torch.arange(30) % 2 == 0).expand(2, -1)
    run = watched(torch.zeros(2, 30, 3).double(), available)
    assert (run.errors[-1].white == 1).all() and (torch.stack(run.variances) == 0).all()


def test_a_receiver_that_holds_its_position_at_a_stop_is_not_taken_for_exact():
    run = watched(torch.zeros(2, 60, 3).double(), speed=0.0)
    assert (run.errors[-1].white == 1).all() and (torch.stack(run.noises) == 1).all()
    for known in ({"speed": 1.0}, {"speed": 0.0, "claim": 0.1}):  # in motion, or by the carrier phase
        assert (watched(torch.zeros(2, 60, 3).double(), **known).noises[-1][:, 0] < 0.8).all()


def test_a_fix_gets_the_noise_that_it_has():
    """Claimed 2 m. White noise of 2 m keeps it, of 0.2 m (cars 8 to 16) has a tenth, down to the weight of the claim
    at the begin (3 of 153 fixes of the mean square, √0.03); 2 cm are the least, and more than claimed is none given."""
    white = torch.randn(8, 150, 3, generator=torch.Generator().manual_seed(1)).double()
    factors = torch.stack(watched(STD * torch.cat((white, 0.1 * white))).noises).unflatten(1, (2, 8))
    assert (factors[..., 2:] == 1).all()
    assert 0.75 < factors[-1, 0, :, 1].mean() < 1.2 and 0.12 < factors[-1, 1, :, 1].mean() < 0.3  # down
    begin, after = factors[0, ..., 0], factors[-1, ..., 0]
    assert (begin == 1).all() and 0.8 < after[0].mean() < 1.2 and after[0].min() > 0.7
    assert 0.12 < after[1].mean() < 0.185 and factors[10, 1, :, 0].mean() < 0.65  # a dozen fixes show it
    exact = watched(torch.zeros(2, 150, 3).double(), claim=0.02).noises[-1]
    assert torch.allclose(exact[:, 0], exact.new_tensor(0.5))  # 2 cm of the 4 that a filter takes it for
    assert (watched(3 * STD * white).noises[-1] == 1).all()


def test_noise_that_grows_is_seen_within_ten_fixes():
    """Tenfold after 280 fixes, of which the means over 300 see a thirtieth: half of the variance by the last ten."""
    white = torch.randn(8, 291, 3, generator=torch.Generator().manual_seed(1)).double()
    grows = torch.where(torch.arange(291)[:, None] < 280, 0.1, 1.0)
    before, after = torch.stack(watched(STD * grows * white).noises)[[279, 290], :, 0].mean(1)
    assert before < 0.32 and after > 0.48


def test_the_stated_1σ_of_a_position_has_what_no_filter_averages():
    """Claimed are 2 m: of a constant error nearly all, of white noise little; the other states keep theirs. Once the
    slow part is a state, nothing of it."""
    std = torch.full((8, 15), 0.3, dtype=torch.float64)
    white = STD * torch.randn(8, 300, 3, generator=torch.Generator().manual_seed(3)).double()
    constant, noisy = (watched(x).errors[-1] for x in (torch.ones(8, 300, 3).double(), white))
    torch.testing.assert_close(constant._replace(modelled=1.0 + 0 * constant.modelled).add_slow_std(std), std)
    constant, noisy = (x.add_slow_std(std) for x in (constant, noisy))
    assert torch.allclose(constant[:, :3], constant.new_tensor((0.3**2 + 0.99 * STD**2) ** 0.5), rtol=0.03)
    assert noisy[:, :2].mean() < 0.9 and (constant[:, 3:] == 0.3).all() and constant.shape == std.shape


def test_what_moves_slowly_is_no_noise():
    """A walk of 0.3 m per second: its changes in four seconds have a variance of 4 · 0.3², half of it is noise,
    beside what is left of the claim."""
    steps = 0.3 * torch.randn(8, 300, 3, generator=torch.Generator().manual_seed(2)).double()
    run = watched(steps.cumsum(1))
    expected = (2 * 0.3**2 + 0.5 * 0.3**2 + 3 / 303 * STD**2) ** 0.5 / STD
    assert abs(float(run.noises[-1][:, 0].mean()) / expected - 1) < 0.1


def test_a_receiver_that_says_that_it_is_worse_is_believed():
    """Two minutes of errors that walk by 0.15 m a second with a claim of 1 m, hardly white; then fixes 8 m off that
    claim 10 m, as before a tunnel. Their noise is nearly as claimed, and nothing wanders by metres; what the means say
    of usual fixes stays, and so does their noise afterwards."""
    T, bad = 150, slice(120, 135)
    g = torch.Generator().manual_seed(4)
    errors = 0.15 * torch.randn(4, T, 3, generator=g).double().cumsum(1)
    claim = torch.full((4, T, 3), 1.0, dtype=torch.float64)
    errors[:, bad, :2] += 8.0 * torch.nn.functional.normalize(torch.randn(4, 1, 2, generator=g), dim=-1)
    claim[:, bad] = 10.0
    run = watched(errors, claim=claim)
    noise, variance = (torch.stack(x)[..., 0] for x in (run.noises, run.variances))
    white, slow = (torch.stack([getattr(e, name) for e in run.errors])[..., 0] for name in ("white", "slow"))
    assert (noise[110:120] < 0.6).all() and (variance[110:120] > 0.007).all()
    assert (noise[bad] > 0.9).all() and (variance[bad] < 0.5).all() and (slow[bad] < 4.0**2).all()
    assert torch.equal(white[bad.start - 1].expand(bad.stop - bad.start, -1), white[bad])
    assert ((noise[140:] - noise[119]).abs() < 0.1).all()


def test_a_receiver_that_stays_worse_is_learned_anew():
    """Half a minute of centimetres, then five minutes of 2 m that wander: after these, as of such a receiver."""
    T, first = 330, 30
    g, decay = torch.Generator().manual_seed(5), math.exp(-1 / TAU)
    errors, now = torch.zeros(8, T, 3, dtype=torch.float64), STD * torch.randn(8, 3, generator=g)
    for k in range(first, T):
        errors[:, k] = now = decay * now + math.sqrt(1 - decay**2) * STD * torch.randn(8, 3, generator=g)
    claim = torch.where(torch.arange(T) < first, 0.02, STD).double()[None, :, None].expand(8, -1, 3)
    last = watched(errors, claim=claim).errors[-1]
    assert (last.usual.sqrt() > 0.95 * STD).all() and (last.white.mean(0) < 0.15).all()
    assert (last.slow > (0.7 * STD) ** 2).all()
