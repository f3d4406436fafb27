"""
Trains the paper's biped for a short while and makes ``sb3_gae/lab/biped.npz``, the rollout that ships with the dial.

    python docs/record_biped.py
    python docs/record_biped.py --steps 20000 --horizon 100 --file /tmp/biped.npz      # a look at whether it works
"""

import argparse
from pathlib import Path

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae import LOCOMOTION_NETWORKS, TRPOGAE, MujocoVecEnv, SaveRolloutCallback
from sb3_gae.lab.rollout_view import SHIPPED_ROLLOUT

SETTINGS = dict(gamma=0.995, gae_lambda=0.97, target_kl=0.03, policy_kwargs=LOCOMOTION_NETWORKS, seed=0)


def bipeds(n_envs: int) -> VecEnv:
    return make_vec_env("GaeBiped-v0", n_envs=n_envs, seed=0, vec_env_cls=MujocoVecEnv)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300_000, help="of the training (default: %(default)s)")
    parser.add_argument("--horizon", type=int, default=256, help="steps of each environment in a batch (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=16, help="to record (default: %(default)s)")
    parser.add_argument("--file", type=Path, default=SHIPPED_ROLLOUT, help="to write (default: the one that ships)")
    options = parser.parse_args()
    model = TRPOGAE("MlpPolicy", VecNormalize(bipeds(32), norm_reward=False), n_steps=options.horizon, **SETTINGS)
    model.learn(options.steps)
    # A batch of its own to record: one whole episode of each environment
    environment = VecNormalize(bipeds(options.episodes), norm_reward=False, training=False)
    environment.obs_rms = model.get_vec_normalize_env().obs_rms
    recorder = TRPOGAE("MlpPolicy", environment, n_steps=2_000, n_episodes=1, **SETTINGS)
    recorder.policy.load_state_dict(model.policy.state_dict())
    name = f"GaeBiped-v0 after {model.num_timesteps:_} steps".replace("_", " ")
    recorder.learn(1, callback=SaveRolloutCallback(options.file, name=name))


if __name__ == "__main__":
    main()
