"""White noise of accelerometers and gyroscopes by virtual outages in the recent past.

Beside a Kalman filter runs the trajectory that its own IMU gives without any correction since some update (a virtual
outage). To first order it differs from the filter's by what the corrections have moved since, d ← Φ d + dx, and a fix
that the filter was given is, for it, one of an outage of so many seconds:

    z_o = z + H d,    S_o(a, g) = H (P_o + a² Q_a + g² Q_g) Hᵀ + R

with P_o the covariance at the start of the outage, carried on with all noise but the white one, and Q_a, Q_g what
the white noise of accelerometers and gyroscopes has added since. S_o is linear in the squares of their levels a and g,
so one trajectory scores all of them: the log density of z_o (position, Student's t) after 10, 20 and 30 s is summed
over the outages, older ones forgotten, and with a log-normal prior about 1 gives a posterior of (ln a, ln g) on a grid.
Its mean is the level in force. Gyroscopes tilt the horizontal acceleration and hardly move the height, so the height
tells accelerometers from gyroscopes; it counts with ``HEIGHT``, since the vertical accelerometer need not be as noisy
as the others. Innovations after 1 s say how noisy a fix is; those after 10 to 30 s what matters in an outage. Without
fixes nothing is learned.

A network that scales the noise of the gyroscopes is judged by the same outages: beside Q_g with its factors runs Q_g
without, and the posterior has both. The probability w of the network is the weight of its factors, κ^w.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.branches import may_branch, select_branch
from dlkf.filters.integration import Covariances, Epoch
from dlkf.filters.kalman_update import propagate_covariance
from dlkf.navigation.error_model import WindowModel
from dlkf.navigation.state import ATTITUDE, PVA, STATES

SCORED_S, LAST_S, STALE_S = 10.0, 30.0, 45.0  # ages at which an outage is scored: each multiple up to the last; too old
MEMORY_S = 600.0  # of fixes, over which an outage is forgotten
FREEDOM = 4.0  # of Student's t: an outlier decides nothing
HEIGHT = 0.25  # weight of the log density of a height
SPREAD = 1.0  # 1σ of ln(level) before anything is known
TRUST = 0.9  # probability of a network's factors before anything is known
LEVELS = tuple(2.0**k for k in range(-5, 6))  # of both sensors


class VirtualOutage(NamedTuple):
    """The trajectory without corrections, and the evidence for the levels so far."""

    drift: Tensor  # (B, n) d: the filter's estimate less that of the trajectory
    P: Tensor  # (B, n, n) of the trajectory but for the white noise since it began
    white: Tensor  # (B, 3, 9, 9) which adds so much at level 1: Q_a, Q_g, Q_g without a network's factors
    age: Tensor  # (B,) s
    due: Tensor  # (B,) s, the age from which on the next fix is scored
    evidence: Tensor  # (B, 2, L, L) ln p of the scored fixes with the network and without, by levels, no prior

    @classmethod
    def begin(cls, P: Float[Tensor, "B n n"]) -> VirtualOutage:
        """One that starts with the filter, without evidence."""
        zeros, B, n = P.new_zeros, len(P), P.shape[-1]
        due = zeros(B) + SCORED_S
        return cls(zeros(B, n), P, zeros(B, 3, 9, 9), zeros(B), due, zeros(B, 2, len(LEVELS), len(LEVELS)))

    def estimates(self) -> tuple[Float[Tensor, "B 2"], Float[Tensor, " B"]]:
        """Factors on the standard deviations of the white noise of accelerometers and gyroscopes, 1 where nothing was
        said; and the weight of the network's factors."""
        x = self.evidence.new_tensor([math.log(level) for level in LEVELS])
        prior = -0.5 * (x / SPREAD).square()
        of_network = self.evidence.new_tensor([math.log(TRUST), math.log(1 - TRUST)])[:, None, None]
        ln = self.evidence + (prior[:, None] + prior + of_network)
        p = torch.exp(ln - ln.amax((1, 2, 3), keepdim=True))
        of_both = p.sum(1)
        total = of_both.sum((1, 2))
        mean = torch.stack(((of_both.sum(2) * x).sum(1), (of_both.sum(1) * x).sum(1)), -1) / total.unsqueeze(-1)
        said = self.evidence.abs().flatten(1).amax(1, keepdim=True) > 0
        return torch.where(said, torch.exp(mean), 1.0), p[:, 0].sum((1, 2)) / total

    def update(
        self, epoch: Epoch, c: Covariances, windows: WindowModel, scale: Float[Tensor, "B 4 3 3"]
    ) -> VirtualOutage:
        """After an update of the filter; ``scale`` is that of its noise at level 1, with the network's factors."""
        Phi = c.Phi
        by_source = windows.noise_by_source(Phi, scale)
        top = Phi[:, PVA]
        drift = torch.cat((torch.bmm(top, self.drift.unsqueeze(-1)).squeeze(-1), self.drift[:, PVA.stop :]), -1)
        P = self._predict_covariance(top, by_source[:, 2:].sum(1), windows.walk)
        F = top[:, None, :, PVA]
        L = Phi[:, PVA, ATTITUDE]
        plain = (L @ L.mT) * windows.spread[1, PVA, PVA]
        white = F @ self.white @ F.mT + torch.cat((by_source[:, :2, PVA, PVA], plain.unsqueeze(1)), 1)
        age = self.age + epoch.span_s

        fixed = epoch.used[:, :2].all(-1)
        scored = fixed & (age >= self.due) & (age < STALE_S)
        gained = torch.zeros_like(self.evidence)
        if not may_branch(scored) or bool(scored.any()):
            gained = select_branch(scored, _log_evidence(epoch, c, drift, P, white), gained)
        kept = 1 - fixed.to(age.dtype) * (epoch.span_s / MEMORY_S)
        evidence = kept[:, None, None, None] * self.evidence + gained

        over = fixed & ((scored & (self.due >= LAST_S)) | (age >= STALE_S))
        due = torch.where(scored, self.due + SCORED_S, self.due)
        o, oo = over[:, None], over[:, None, None]
        return VirtualOutage(
            torch.where(o, 0.0, drift + c.dx), torch.where(oo, c.updated, P), torch.where(oo[..., None], 0.0, white),
            torch.where(over, 0.0, age), torch.where(over, SCORED_S, due), evidence,
        )  # fmt: skip

    def _predict_covariance(
        self, top: Float[Tensor, "B 9 n"], of_walks: Float[Tensor, "B s s"], walk: Float[Tensor, " n"]
    ) -> Float[Tensor, "B n n"]:
        """Φ P Φᵀ + Q of all noise but the white one; below position, velocity and attitude Φ is taken for 1."""
        P = propagate_covariance(self.P, top)
        P[:, :STATES, :STATES] += of_walks
        P.diagonal(dim1=-2, dim2=-1).add_(walk)
        return P


def _log_evidence(
    epoch: Epoch, c: Covariances, drift: Float[Tensor, "B n"], P: Float[Tensor, "B n n"],
    white: Float[Tensor, "B 3 9 9"],
) -> Float[Tensor, "B 2 L L"]:  # fmt: skip
    """Log likelihood of the levels from one fix, with a network's factors and without."""
    H = c.H[:, :3]
    z = epoch.z[:, :3] + torch.bmm(H, drift.unsqueeze(-1)).squeeze(-1)
    known = torch.bmm(torch.bmm(H, P), H.mT) + torch.diag_embed(c.R[:, :3])
    added = H[:, None, :, PVA] @ white @ H[:, None, :, PVA].mT
    height = torch.where(epoch.used[:, 2], HEIGHT, 0.0)[:, None, None]
    return torch.stack([_log_density(z, known, x, height) for x in (added[:, :2], added[:, ::2])], 1)


def _log_density(
    z: Float[Tensor, "B 3"], known: Float[Tensor, "B 3 3"], added: Float[Tensor, "B 2 3 3"],
    height: Float[Tensor, "B 1 1"],
) -> Float[Tensor, "B L L"]:  # fmt: skip
    """ln p(z) but for a constant, for all levels a, g: Student's t with S = known + a² added₀ + g² added₁ of the
    horizontal part, and that of the vertical one with the weight ``height``."""
    square = z.new_tensor([level**2 for level in LEVELS])
    a, g = square[:, None], square

    def of(i: int, j: int) -> Tensor:
        k, x = known[:, i, j, None, None], added[:, :, i, j, None, None]
        return k + a * x[:, 0] + g * x[:, 1]

    nn, ne, ee, dd = of(0, 0), of(0, 1), of(1, 1), of(2, 2)
    n, e, d = z[:, :, None, None].unbind(1)
    det = nn * ee - ne * ne
    horizontal = _student_t((ee * n * n - 2 * ne * n * e + nn * e * e) / det, det, 2)
    return horizontal + height * _student_t(d * d / dd, dd, 1)


def _student_t(distance: Float[Tensor, "B L L"], det: Float[Tensor, "B L L"], count: int) -> Float[Tensor, "B L L"]:
    """ln p of ``count`` numbers of a squared Mahalanobis distance and the determinant of S."""
    return -0.5 * torch.log(det) - 0.5 * (FREEDOM + count) * torch.log1p(distance / FREEDOM)
