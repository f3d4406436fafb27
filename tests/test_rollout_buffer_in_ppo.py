"""The rollout buffer in SB3's own PPO."""

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_gae import GAERolloutBuffer


class KeepRollouts(BaseCallback):
    """Copies of what each rollout was made into."""

    def __init__(self) -> None:
        super().__init__()
        self.advantages: list[np.ndarray] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.advantages.append(self.locals["rollout_buffer"].advantages.copy())


def run_ppo(buffer_class: type[RolloutBuffer], n_envs: int) -> tuple[PPO, KeepRollouts]:
    # So short a limit that there are truncations as well as terminations
    env = make_vec_env(lambda: gym.make("CartPole-v1", max_episode_steps=12), n_envs, seed=0)
    keep = KeepRollouts()
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=48,
        batch_size=24,
        n_epochs=2,
        seed=0,
        device="cpu",
        policy_kwargs={"net_arch": [8]},
        rollout_buffer_class=buffer_class,
    )
    return model.learn(48 * n_envs * 4, callback=keep), keep


def test_ppo_of_sb3_learns_bit_for_bit_the_same_with_this_buffer() -> None:
    (ours, kept), (theirs, kept_by_sb3) = (run_ppo(each, n_envs=1) for each in (GAERolloutBuffer, RolloutBuffer))
    assert len(kept.advantages) == len(kept_by_sb3.advantages) == 4
    for our_advantages, their_advantages in zip(kept.advantages, kept_by_sb3.advantages, strict=True):
        assert np.array_equal(our_advantages, their_advantages)
    for name, parameter in theirs.policy.state_dict().items():
        assert th.equal(ours.policy.state_dict()[name], parameter), name


def test_ppo_of_sb3_gets_the_same_first_rollout_from_several_environments() -> None:
    # After it the two differ by the order of minibatches: SB3 flattens environments first, this buffer time
    (ours, kept), (_, kept_by_sb3) = (run_ppo(each, n_envs=3) for each in (GAERolloutBuffer, RolloutBuffer))
    assert np.array_equal(kept.advantages[0], kept_by_sb3.advantages[0])
    assert len(kept.advantages) == 4
    assert ours.rollout_buffer.dones.any()
    assert all(th.isfinite(parameter).all() for parameter in ours.policy.parameters())
