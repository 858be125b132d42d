"""The IMU error of a filter: what is taken off the samples is what the model adds to them."""

import pytest
import torch

from dlkf.navigation.calibration import ImuError

D = torch.float64


def errors(matrix: str) -> tuple[ImuError, torch.Tensor]:
    """Of three units, and their sensor matrices (3, 6, 6) written out."""
    g = torch.Generator().manual_seed(3)
    bias = 0.1 * torch.randn(3, 6, generator=g, dtype=D)
    elements = 0.02 * torch.randn(3, 2, 3, 3, generator=g, dtype=D)
    whole = torch.zeros(3, 6, 6, dtype=D)
    if matrix == "full":
        whole[:, :3, :3], whole[:, 3:, 3:] = elements.unbind(1)
        return ImuError(bias, elements), whole
    if matrix == "scale":
        scale = elements.flatten(1)[:, :6]
        return ImuError(bias, scale), torch.diag_embed(scale)
    return ImuError(bias), whole


@pytest.mark.parametrize("matrix", ["none", "scale", "full"])
def test_correcting_undoes_the_error_and_at_names_it(matrix):
    """measured = (I + M) true + bias, to rounding."""
    error, M = errors(matrix)
    true = torch.randn(3, 20, 6, generator=torch.Generator().manual_seed(4), dtype=D)
    measured = true + torch.einsum("bij,bmj->bmi", M, true) + error.bias[:, None]
    torch.testing.assert_close(error.correct(measured), true, rtol=0, atol=1e-12)
    torch.testing.assert_close(error.at(true.mean(1)), (measured - true).mean(1), rtol=0, atol=1e-12)


def test_gradient_through_full_matrices_is_the_numerical_one():
    """In closed form, for bias and elements."""
    error, _ = errors("full")
    raw = torch.randn(3, 5, 6, generator=torch.Generator().manual_seed(5), dtype=D)
    given = [x.requires_grad_() for x in error if x is not None]
    assert torch.autograd.gradcheck(lambda *parts: ImuError(*parts).correct(raw), given)
