"""A Gaussian policy over a batch, in a few passes over it."""

import math

import torch as th


class DiagonalGaussian:
    r"""
    :math:`N(\mu_n, \mathrm{diag}\,\sigma^2)` for each sample n: the deviations are a parameter of their own, the same in all.

    torch's own distribution, which SB3's wraps, has deviations for each sample, checks all of its numbers, and takes several
    times as many passes over the batch. Here numbers that are not finite go through to the results.

    :param mean: shape (B, n_actions)
    :param log_std: logarithms of the deviations, shape (n_actions,)
    """

    def __init__(self, mean: th.Tensor, log_std: th.Tensor):
        self.mean = mean
        # The parameter itself is about to move
        self.log_std = log_std.clone()

    @property
    def precision(self) -> th.Tensor:
        """Of each action, shape (n_actions,)."""
        return th.exp(-2.0 * self.log_std)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: shape (B, n_actions)
        :return: logarithms of their densities, shape (B,)
        """
        constant = self.log_std.sum() + 0.5 * math.log(2.0 * math.pi) * len(self.log_std)
        return -0.5 * th.mv((actions - self.mean).square(), self.precision) - constant

    def mean_kl(self, new: "DiagonalGaussian") -> th.Tensor:
        r"""
        :param new: over the same batch
        :return: mean over the batch of :math:`D_{KL}` of this one from ``new``, a scalar in nats
        """
        of_means = th.mv((self.mean - new.mean).square(), new.precision).mean()
        change = 2.0 * (self.log_std - new.log_std)
        return 0.5 * (of_means + (change.expm1() - change).sum())
