"""The gate's verdict on one position, by hand: when refused fixes agree, and how far P is then opened."""

import pytest
import torch

from dlkf.filters.gating import AGREEMENT_SPEED, PATIENCE, Gate, Verdict
from dlkf.filters.integration import Fix
from dlkf.navigation.calibration import ImuError

from .scene import scene
from .test_constraints import epoch_of


def judged(off: float, before: float, refused: int) -> tuple[float, Verdict]:
    """A position ``off`` [m] along north where S has 2 m (1σ), a second after one ``before`` [m] off that was the
    last of ``refused``; fixes of 1 cm. How many are refused now, and the verdict."""
    batch = scene(1, 1)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(1, 6)))
    z, used = torch.zeros_like(epoch.z), torch.tensor([[True] * 3 + [False] * 3])
    z[0, 0] = off
    fix = Fix(z, torch.full_like(z, 0.01), used, None)
    gate = Gate(0.999)
    memory = gate.begin(epoch.z)
    memory.innovation[0, 0], memory.refused[0] = before, refused
    after, verdict = gate.judge(
        memory, epoch._replace(z=z, fix=fix), torch.diag_embed(torch.where(used, 4.0, 1.0).to(z)), fix.std.square()
    )
    return float(after.refused), verdict


def test_a_refused_position_agrees_with_one_as_far_off():
    """Within 6σ of both fixes, √6 cm (three axes each), and what 2 m/s make of the second between them."""
    limit = 6 * 0.01 * 6**0.5 + AGREEMENT_SPEED
    assert judged(50.0, 50.0 - limit + 0.01, 2)[0] == 3
    assert judged(50.0, 50.0 - limit - 0.01, 2)[0] == 1


def test_p_is_opened_by_what_contradicts_it():
    """At the last of the agreeing refusals: by z² in itself, and all of it by the mean of z²/S over the components."""
    kept = judged(12.0, 12.0, PATIENCE - 2)[1]
    assert float(kept.factor) == 1.0 and not kept.shift.any() and not kept.passed.any()
    left, opened = judged(12.0, 12.0, PATIENCE - 1)
    assert left == 0 and float(opened.factor) == pytest.approx(12.0**2 / 4 / 3)
    assert opened.shift[0].tolist() == [144.0, 0, 0, 0, 0, 0] and opened.passed[0].tolist() == [True] * 3 + [False] * 3
    P = torch.eye(9, dtype=opened.factor.dtype)[None]
    assert opened.opened(P)[0].diagonal().tolist() == pytest.approx([156.0, *[12.0] * 8])
