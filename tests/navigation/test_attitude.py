"""Rotations against scipy, over the whole range of angles."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dlkf.navigation import compiled
from dlkf.navigation.attitude import (
    orthonormalise,
    prefix_rotations,
    quaternion_from_rotation,
    rotation_from_rpy,
    rotation_from_vector,
    rpy_from_rotation,
    skew,
    vector_from_rotation,
)

ROUNDING = 1e-12


def vectors(scale: float, n: int = 200) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    u = torch.randn(n, 3, generator=g, dtype=torch.float64)
    return scale * u / u.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("loops", [True, False])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.0999, 0.1001, 1.0, 3.0, 3.1415])
def test_exponential_and_logarithm(angle, loops):
    """By compiled loops, as where no gradient is asked for, and by tensor operations."""
    phi = vectors(angle)
    with torch.set_grad_enabled(not loops):
        C = rotation_from_vector(phi)
        back = vector_from_rotation(C)
    assert np.abs(C.numpy() - Rotation.from_rotvec(phi.numpy()).as_matrix()).max() < ROUNDING
    # near π the quaternion's scalar is small and so is the digits' worth
    assert (back - phi).abs().max() < (1e-7 if angle > 3.14 else 1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.05, 0.2, 2.0])
def test_exponential_has_a_gradient_everywhere(angle):
    phi = vectors(angle, 3).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_vector, phi)


def test_cross_product_matrix():
    a, b = vectors(1.0), vectors(2.0).flip(0)
    assert torch.allclose((skew(a) @ b.unsqueeze(-1)).squeeze(-1), torch.linalg.cross(a, b))


def test_roll_pitch_yaw_and_quaternion():
    rpy = torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 2 - 1
    rpy = rpy * torch.tensor([3.1, 1.5, 3.1], dtype=torch.float64)
    C = rotation_from_rpy(rpy)
    expected = Rotation.from_euler("ZYX", rpy.flip(-1).numpy())
    assert np.abs(C.numpy() - expected.as_matrix()).max() < ROUNDING
    assert (rpy_from_rotation(C) - rpy).abs().max() < 1e-9
    q = quaternion_from_rotation(C).numpy()
    theirs = expected.as_quat(scalar_first=True)
    assert np.abs(q * np.sign((q * theirs).sum(-1, keepdims=True)) - theirs).max() < ROUNDING


@pytest.mark.parametrize("samples", [1, 2, 7, 50, 100])
def test_prefix_products_equal_the_loop(samples):
    """Turning up to 0.3 rad per sample, which is 860 °/s at 50 Hz."""
    phi = 0.15 * torch.randn(4, samples, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    got = prefix_rotations(phi.permute(2, 0, 1)).permute(2, 3, 0, 1)
    C = Rotation.identity(4)
    for k in range(samples):
        C = C * Rotation.from_rotvec(phi[:, k].numpy())
        assert np.abs(got[:, k].numpy() - C.as_matrix()).max() < ROUNDING


def test_orthonormalised_removes_rounding():
    C = rotation_from_vector(vectors(1.0)) + 1e-6 * torch.randn(200, 3, 3, dtype=torch.float64)
    O = orthonormalise(C)
    assert (O @ O.mT - torch.eye(3)).abs().max() < 1e-10  # squares the 1e-6 that came in


def test_compiled_rotations_are_the_tensor_form_s():
    phi = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    phi[0, 0] = 0.0
    phi[0, 1] = 1e-9
    with compiled.tensor_forms():
        expected = rotation_from_vector(phi)
    with torch.no_grad():
        assert compiled.fits(phi)
        assert (rotation_from_vector(phi) - expected).abs().max() < 1e-14
