"""Covariance matching: a Kalman filter's noise judged by the fixes (Mehra 1972, "Approaches to adaptive filtering").

Where the noise is what the filter takes it for, an innovation's square is its variance, and the square of a correction
what the covariance loses by it:

    E[zᵢ²] = (H P Hᵀ + R)ᵢᵢ,    E[dxᵢ²] = (P⁻ − P⁺)ᵢᵢ

Which noise is too small is separated by axes, as far as the motion allows, so everything is kept per axis: innovations
in heading axes, corrections in body axes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.navigation.state import ATTITUDE, IMU, PV, VELOCITY

MEMORIES = (10.0, 60.0)  # fixes
LARGEST = 1e3  # of a ratio: the most that one outlier counts
SIZES = (0.05,) * 3 + (2e-3,) * 3 + (5e-3,) * 3 + (1e-4,) * 3  # typical corrections: m/s, rad, m/s², rad/s
LOG_FEATURES, AXIS_FEATURES = 12 + 24 + 12, 8 + 4


def variance_along(P: Float[Tensor, "B k k"], axes: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B k"]:
    """Diagonal of Cᵀ P C for every 3 × 3 block on the diagonal of P; the columns of C are the axes."""
    blocks = P.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3)).diagonal(dim1=1, dim2=3)  # (B, 3, 3, blocks)
    along = torch.bmm(axes.mT, blocks.flatten(2)).unflatten(-1, (3, -1))
    return (along * axes.mT.unsqueeze(-1)).sum(2).mT.flatten(1)


def normalised_innovation(
    P: Float[Tensor, "B n n"], z: Float[Tensor, "B 6"], std: Float[Tensor, "B 6"], C_hn: Float[Tensor, "B 3 3"],
    least: float,
) -> Float[Tensor, "B 6"]:  # fmt: skip
    """Innovations of position and velocity over √(P + R + ``least``), in the axes of C_hn; zero stays zero."""
    variance = variance_along(P[:, PV, PV], C_hn.mT)
    R = torch.bmm(std.square().unflatten(-1, (2, 3)), C_hn.mT.square()).flatten(1)
    z = torch.bmm(z.unflatten(-1, (2, 3)), C_hn.mT).flatten(1)
    return z / (variance + R + least).sqrt()


class Matching(NamedTuple):
    """Running means over the last fixes, short and long; one before the first fix."""

    innovations: Tensor  # (B, 2, 6) z² over its variance; position, velocity; forward, right, down
    ratios: Tensor  # (B, 2, 12) dx² over what P loses; velocity, attitude, accelerometer, gyroscope; body axes
    sizes: Tensor  # (B, 12) dx² over SIZES², short
    fixes: Tensor  # (B,)

    @classmethod
    def begin(cls, like: Tensor, size: int) -> Matching:
        """Memory before the first fix."""
        one = like.new_ones
        return cls(one(size, 2, 6), one(size, 2, 12), one(size, 12), like.new_zeros(size))

    def update(self, normalised: Float[Tensor, "B 6"], used: Bool[Tensor, "B 6"]) -> Matching:
        """After an innovation over its 1σ, in heading axes."""
        fixes = self.fixes + used.any(-1)
        new = normalised.square().clamp_max(LARGEST).unsqueeze(1)
        innovations = torch.where(used.unsqueeze(1), _blend(self.innovations, new, fixes), self.innovations)
        return self._replace(innovations=innovations, fixes=fixes)

    def update_ratios(
        self, dx: Float[Tensor, "B n"], prior: Float[Tensor, "B n n"], posterior: Float[Tensor, "B n n"],
        C_nb: Float[Tensor, "B 3 3"], fixed: Bool[Tensor, " B"],
    ) -> Matching:  # fmt: skip
        """After the correction of an epoch; unchanged without a fix."""
        both = slice(VELOCITY.start, ATTITUDE.stop)
        turned = torch.bmm(dx[:, both].unflatten(-1, (2, 3)), C_nb).flatten(1)
        squares = torch.cat((turned, dx[:, IMU]), -1).square()
        moving = slice(VELOCITY.start, IMU.stop)
        lost = prior[:, moving, moving] - posterior[:, moving, moving]
        expected = torch.cat((variance_along(lost[:, :6, :6], C_nb), lost.diagonal(dim1=-2, dim2=-1)[:, 6:]), -1)
        size = squares.new_tensor(SIZES).square()
        ratio = (squares / (expected.clamp_min(0.0) + 1e-9 * size)).clamp_max(LARGEST)
        ratios = _blend(self.ratios, ratio.unsqueeze(1), self.fixes)
        sizes = _blend(self.sizes.unsqueeze(1), (squares / size).clamp_max(LARGEST).unsqueeze(1), self.fixes)
        return self._replace(
            ratios=torch.where(fixed[:, None, None], ratios, self.ratios),
            sizes=torch.where(fixed[:, None], sizes[:, 0], self.sizes),
        )

    def logarithms(self) -> Float[Tensor, "B L"]:
        """Network features of it, each of order 1."""
        parts = (self.innovations.flatten(1), self.ratios.flatten(1), self.sizes)
        return torch.log(torch.cat(parts, -1) + 1e-3) / 2


def ratio_by_axis(logarithms: Float[Tensor, "B L"]) -> Float[Tensor, "B 3 12"]:
    """What of the logarithms belongs to each body axis: ratios of both memories, sizes."""
    return logarithms[:, 12:].unflatten(-1, (-1, 3)).mT


def _blend(mean: Float[Tensor, "B k m"], new: Float[Tensor, "B 1 m"], fixes: Float[Tensor, " B"]) -> Tensor:
    """Running means: true ones over the first fixes, then fading."""
    share = 1 / fixes[:, None].clamp_min(1).clamp_max(mean.new_tensor(MEMORIES[: mean.shape[1]]))
    return torch.lerp(mean, new.expand_as(mean), share.unsqueeze(-1))
