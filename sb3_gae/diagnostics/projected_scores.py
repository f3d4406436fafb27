r"""
Scores :math:`\nabla_\theta\log\pi(a_t|s_t)` of single steps, projected at random to a few dimensions (torch).

With the scores of all steps at hand, the policy gradient for any advantages is one product. A projection
:math:`P\psi`, the entries of :math:`P` independent, :math:`\pm 1/\sqrt{n}`, keeps inner products on average, so that
norms, bias and variance of gradients can be estimated from it without the policy. The error of a squared norm by the choice of
:math:`P` has a relative standard deviation of at most :math:`\sqrt{2/n}`: a fifth for n = 48.
"""

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.batch import TrainingBatch, batch_size, take
from sb3_gae.checks import check_count
from sb3_gae.diagnostics.policy_gradients import policy_gradients
from sb3_gae.update.policy_step import policy_parameters

# Scores of full length that are in memory at a time, each of 8 bytes a parameter
_CHUNK_ROWS = 128


def projected_scores(policy: ActorCriticPolicy, batch: TrainingBatch, n_dimensions: int, seed: int = 0) -> np.ndarray:
    """
    :param policy: that the actions were drawn from, in evaluation mode
    :param batch: B samples
    :param n_dimensions: n
    :param seed: of the projection
    :return: in single precision, shape (B, n)
    :raises ValueError: if ``n_dimensions`` is not positive
    """
    check_count("n_dimensions", n_dimensions)
    parameters = policy_parameters(policy, batch)
    signs = np.random.default_rng(seed).integers(0, 2, (sum(each.numel() for each in parameters), n_dimensions), dtype=np.int8)
    projection = (2.0 * signs - 1.0) / np.sqrt(n_dimensions)
    n_samples = batch_size(batch.observations)
    result = np.empty((n_samples, n_dimensions), dtype=np.float32)
    for start in range(0, n_samples, _CHUNK_ROWS):
        rows = slice(start, min(start + _CHUNK_ROWS, n_samples))
        n_rows = rows.stop - rows.start
        samples = take(batch.observations, rows), batch.actions[rows]
        scores = policy_gradients(policy, parameters, *samples, np.ones((1, n_rows)), groups=np.arange(n_rows))
        result[rows] = scores[:, 0] @ projection
    return result
