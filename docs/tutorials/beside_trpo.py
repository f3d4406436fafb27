"""
The same samples, two learners: sb3-contrib's TRPO and TRPOGAE with the arguments that they share.

    python docs/tutorials/beside_trpo.py            # a minute and a half
"""

import time

import numpy as np
from sb3_contrib import TRPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gae import TRPOGAE

STEPS, SEEDS = 40_000, 3
SHARED = dict(n_steps=512, gamma=0.9, gae_lambda=0.95, use_sde=False)

for algorithm in (TRPO, TRPOGAE):
    returns, seconds = [], []
    for seed in range(SEEDS):
        env = make_vec_env("Pendulum-v1", n_envs=4, seed=seed)
        model = algorithm("MlpPolicy", env, seed=seed, device="cpu", **SHARED)
        start = time.perf_counter()
        model.learn(STEPS)
        seconds.append(time.perf_counter() - start)
        returns.append(evaluate_policy(model, make_vec_env("Pendulum-v1", n_envs=4, seed=1_000), n_eval_episodes=20)[0])
        env.close()
    print(f"{algorithm.__name__:8s} return {np.mean(returns):7.1f}, seeds {np.round(returns)}; {np.mean(seconds):.1f} s a run")
