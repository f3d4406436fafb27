"""
Trains the paper's biped for a short while and makes ``sb3_gae/lab/biped.npz``, the rollout that ships with the dial.

    python docs/record_biped.py
"""

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae import LOCOMOTION_NETWORKS, TRPOGAE, MujocoVecEnv, SaveRolloutCallback
from sb3_gae.lab.rollout_view import SHIPPED_ROLLOUT

N_STEPS = 300_000
SETTINGS = dict(gamma=0.995, gae_lambda=0.97, target_kl=0.03, policy_kwargs=LOCOMOTION_NETWORKS, seed=0)


def bipeds(n_envs: int) -> VecEnv:
    return make_vec_env("GaeBiped-v0", n_envs=n_envs, seed=0, vec_env_cls=MujocoVecEnv)


def main() -> None:
    model = TRPOGAE("MlpPolicy", VecNormalize(bipeds(32), norm_reward=False), n_steps=256, **SETTINGS)
    model.learn(N_STEPS)
    # A batch of its own to record: one whole episode of each environment
    environment = VecNormalize(bipeds(16), norm_reward=False, training=False)
    environment.obs_rms = model.get_vec_normalize_env().obs_rms
    recorder = TRPOGAE("MlpPolicy", environment, n_steps=2_000, n_episodes=1, **SETTINGS)
    recorder.policy.load_state_dict(model.policy.state_dict())
    recorder.learn(1, callback=SaveRolloutCallback(SHIPPED_ROLLOUT, name=f"GaeBiped-v0 after {N_STEPS // 1_000} 000 steps"))


if __name__ == "__main__":
    main()
