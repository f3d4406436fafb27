"""
The settings of tianshou's published MuJoCo examples (``examples/mujoco/mujoco_trpo.py`` and ``mujoco_npg.py``), which it
gives for all tasks alike. Networks have two hidden layers of tanh units, and observations are normalised.
"""

from typing import Any

from benchmarks.peers.algorithms import TIANSHOU_NPG, TIANSHOU_TRPO

_SHARED: dict[str, Any] = {
    "num_training_envs": 16,
    "buffer_size": 4096,
    "collection_step_num_env_steps": 1024,
    "update_step_num_repetitions": 1,
    "batch_size": None,
    "hidden_sizes": [64, 64],
}
_PARAMS: dict[str, Any] = {
    "lr": 1e-3,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "return_scaling": True,
    "advantage_normalization": True,
    "action_bound_method": "clip",
    "optim_critic_iters": 20,
}
TIANSHOU_SETTINGS: dict[str, dict[str, Any]] = {
    TIANSHOU_NPG: {**_SHARED, "params": {**_PARAMS, "trust_region_size": 0.1}},
    TIANSHOU_TRPO: {**_SHARED, "params": {**_PARAMS, "max_kl": 0.01, "backtrack_coeff": 0.8, "max_backtracks": 10}},
}
