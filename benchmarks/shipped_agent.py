"""An agent with the shipped settings of a task, for measurements of a single part of its learning."""

from typing import Any

import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.peers.settings import settings_for
from sb3_gae import TRPOGAE
from sb3_gae.vec_env import EnvPoolVecEnv
from sb3_gae.zoo import default_hyperparams_path

_ARGUMENTS = ("n_steps", "gamma", "gae_lambda", "target_kl", "cg_damping", "vf_cg_damping")


def shipped_agent(env_id: str, seed: int, model_class: type[TRPOGAE] = TRPOGAE) -> TRPOGAE:
    """
    :param env_id: a MuJoCo task of ``hyperparams/trpo_gae.yml``
    :param seed: of everything
    :param model_class: of the agent
    :return: untrained, on one thread of the CPU
    """
    settings = settings_for(yaml.safe_load(default_hyperparams_path().read_text()), env_id, "trpo_gae.yml")
    pool: Any = EnvPoolVecEnv
    env = make_vec_env(env_id, settings["n_envs"], seed, vec_env_cls=pool, vec_env_kwargs=dict(n_threads=1))
    return model_class(
        settings["policy"],
        VecNormalize(env, norm_reward=False),
        policy_kwargs=eval(settings.get("policy_kwargs", "None")),  # as rl-zoo3 reads its files
        seed=seed,
        device="cpu",
        **{name: settings[name] for name in _ARGUMENTS if name in settings},
    )
