"""
What λ trades, measured: bias against variance of the policy gradient, from the rollouts that a training collects anyway.

    python docs/tutorials/what_lambda_trades.py     # half a minute; writes what_lambda_trades.png
"""

import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_gae import TRPOGAE, GradientDiagnosticsCallback

LAMBDAS = (0.0, 0.36, 0.68, 0.84, 0.92, 0.96, 0.98, 0.99, 1.0)


class KeepErrors(GradientDiagnosticsCallback):
    """One rollout says little, so keep them all."""

    def __init__(self):
        super().__init__(LAMBDAS)
        self.kept = []

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        self.kept.append(self.errors)


# Estimates compare trajectories with each other, so that a batch needs many: 32 environments
env = make_vec_env("CartPole-v1", n_envs=32, seed=0)
model = TRPOGAE("MlpPolicy", env, n_steps=64, gamma=0.98, seed=0)
diagnostics = KeepErrors()
model.learn(30 * 32 * 64, callback=diagnostics)
env.close()

errors = diagnostics.kept[10:]  # the policy of the first batches is another one
bias_squared = np.mean([one.bias_squared for one in errors], axis=0)
variance = np.mean([one.variance for one in errors], axis=0)
best = int(np.argmin(np.maximum(bias_squared, 0) + variance))
print("     λ     bias²   variance")
for row in zip(LAMBDAS, bias_squared, variance, strict=True):
    print("{:6.2f} {:9.2e}  {:9.2e}".format(*row))
print(f"smallest sum: λ = {LAMBDAS[best]}")

figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
places = np.arange(len(LAMBDAS))
axes.bar(places, np.maximum(bias_squared, 0), label="bias² against λ = 1", color="#0072b2")
axes.bar(places, variance, bottom=np.maximum(bias_squared, 0), label="variance", color="#d55e00")
axes.set_xticks(places, [str(value) for value in LAMBDAS])
axes.set(xlabel="λ", ylabel="squared error of the policy gradient", title="CartPole-v1, mean over 20 batches")
axes.legend(frameon=False)
figure.savefig("what_lambda_trades.png", dpi=150)
