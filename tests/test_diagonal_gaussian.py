"""The Gaussian of the fast path against torch's own, in double precision."""

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Independent, Normal, kl_divergence

from sb3_gae.networks.diagonal_gaussian import DiagonalGaussian

shapes = st.tuples(st.integers(1, 5), st.integers(1, 4))
seeds = st.integers(0, 2**16)


def some(shape: tuple[int, int], seed: int, scale: float = 1.0) -> tuple[th.Tensor, th.Tensor]:
    """Means and logarithms of deviations."""
    generator = th.Generator().manual_seed(seed)
    return tuple(scale * th.randn(*size, generator=generator, dtype=th.float64) for size in (shape, shape[1:]))


def of_torch(mean: th.Tensor, log_std: th.Tensor) -> Independent:
    return Independent(Normal(mean, log_std.exp().expand_as(mean)), 1)


@given(shape=shapes, seed=seeds)
def test_densities_and_their_gradients_are_torchs(shape: tuple[int, int], seed: int) -> None:
    mean, log_std = (tensor.requires_grad_() for tensor in some(shape, seed))
    actions, _ = some(shape, seed + 1, 3.0)
    ours, expected = DiagonalGaussian(mean, log_std).log_prob(actions), of_torch(mean, log_std).log_prob(actions)
    th.testing.assert_close(ours, expected)
    gradients = [th.autograd.grad(result.square().sum(), [mean, log_std]) for result in (ours, expected)]
    th.testing.assert_close(*gradients)


@given(shape=shapes, seed=seeds, scale=st.sampled_from([1e-3, 1.0, 3.0]))
def test_the_divergence_is_torchs(shape: tuple[int, int], seed: int, scale: float) -> None:
    old, new = some(shape, seed, scale), some(shape, seed + 1, scale)
    ours = DiagonalGaussian(*old).mean_kl(DiagonalGaussian(*new))
    th.testing.assert_close(ours, kl_divergence(of_torch(*old), of_torch(*new)).mean(), rtol=1e-7, atol=1e-12)
    assert DiagonalGaussian(*old).mean_kl(DiagonalGaussian(*old)) == 0.0


def test_small_changes_of_the_deviation_are_exact_in_single_precision() -> None:
    """A divergence of 1e-8 must not be the rounding of 1."""
    mean, log_std = th.zeros(1, 1), th.zeros(1)
    divergence = DiagonalGaussian(mean, log_std).mean_kl(DiagonalGaussian(mean, log_std + 1e-4))
    assert divergence.item() == pytest.approx(1e-8, rel=1e-3)


def test_it_stays_as_it_is_when_the_parameter_moves() -> None:
    mean, log_std = some((3, 2), 0)
    ours = DiagonalGaussian(mean, log_std)
    before = ours.log_prob(th.zeros(3, 2, dtype=th.float64))
    log_std.add_(1.0)
    assert th.equal(ours.log_prob(th.zeros(3, 2, dtype=th.float64)), before)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_show_in_the_results(bad: float) -> None:
    mean, log_std = some((3, 2), 0)
    broken = mean.clone()
    broken[1, 0] = bad
    assert not DiagonalGaussian(broken, log_std).log_prob(mean)[1].isfinite()
    assert not DiagonalGaussian(mean, log_std).mean_kl(DiagonalGaussian(broken, log_std)).isfinite()
