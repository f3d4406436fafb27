"""Callbacks for training."""

from collections.abc import Sequence

from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae.rollout_buffer import GAERolloutBuffer, LambdaSweep

#: the values of the paper's cart-pole figure
PAPER_LAMBDAS = (0.0, 0.36, 0.68, 0.84, 0.92, 0.96, 0.98, 0.99, 1.0)


class LambdaSweepCallback(BaseCallback):
    r"""
    Logs, after each rollout, what other :math:`\lambda` would have made of it. Needs no further samples.

    Keys are ``sweep/<quantity>/lambda_<value>``, the quantities those of :class:`~sb3_gae.LambdaSweep`.
    The summary of the last rollout is in ``self.sweep``.

    :param lambdas: weights of longer estimates, each in [0, 1]
    :param gamma: discount factor, None for the one in training
    :param verbose: as for SB3's callbacks
    """

    def __init__(self, lambdas: Sequence[float] = PAPER_LAMBDAS, gamma: float | None = None, verbose: int = 0):
        super().__init__(verbose)
        self.lambdas = tuple(lambdas)
        self.gamma = gamma
        self.sweep: LambdaSweep | None = None

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        rollout_buffer = self.locals["rollout_buffer"]
        if not isinstance(rollout_buffer, GAERolloutBuffer):
            raise TypeError(f"LambdaSweepCallback needs a sb3_gae.GAERolloutBuffer, got {type(rollout_buffer).__name__}.")
        self.sweep = rollout_buffer.lambda_sweep(self.lambdas, self.gamma)
        for quantity, values in self.sweep._asdict().items():
            if quantity != "gae_lambda":
                for gae_lambda, value in zip(self.lambdas, values, strict=True):
                    self.logger.record(f"sweep/{quantity}/lambda_{gae_lambda:g}", float(value))
