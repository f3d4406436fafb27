"""
A training that is stopped in the middle and continued ends where it would have ended, bit for bit.

    python docs/tutorials/stop_and_continue.py      # some seconds; writes checkpoints/
"""

import torch
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae import TRPOGAE, ResumableCheckpointCallback

TOTAL = 10 * 8 * 128


def make_env() -> VecNormalize:
    return VecNormalize(make_vec_env("CartPole-v1", n_envs=8, seed=0), norm_reward=False)


# In one go
whole = TRPOGAE("MlpPolicy", make_env(), n_steps=128, seed=0)
whole.learn(TOTAL)

# With a checkpoint after each iteration, and an end that comes too early: in its place think of a machine that is switched off
checkpoints = ResumableCheckpointCallback(save_freq=1, save_path="checkpoints")
early_end = StopTrainingOnMaxEpisodes(max_episodes=10)  # of each environment
TRPOGAE("MlpPolicy", make_env(), n_steps=128, seed=0).learn(TOTAL, callback=[checkpoints, early_end])

# Later, perhaps on another machine
continued = TRPOGAE.resume("checkpoints", make_env())
print(f"continues at {continued.num_timesteps} steps, with {continued.remaining_timesteps} left")
continued.learn(continued.remaining_timesteps, callback=checkpoints, reset_num_timesteps=False)

pairs = zip(whole.policy.parameters(), continued.policy.parameters(), strict=True)
print("the same, bit for bit:", all(torch.equal(one, other) for one, other in pairs))
