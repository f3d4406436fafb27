"""Training works on every space, within the trust region."""

from typing import Any

import numpy as np
import pytest
from envs_for_tests import (
    ACTIONS,
    CHANNEL_FIRST,
    SMALL,
    VECTOR,
    AnySpacesEnv,
    check_training,
    small_model,
    train_once,
    vec_env,
)
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, VecTransposeImage, is_vecenv_wrapped

ACTION_SPACES = {
    "Box": spaces.Box(-1.0, 1.0, (3,), np.float32),
    "Box 2x2": spaces.Box(-1.0, 1.0, (2, 2), np.float32),
    "Box asymmetric": spaces.Box(np.float32([-3.0, 0.5]), np.float32([1.0, 2.0])),
    "Discrete": spaces.Discrete(4),
    "MultiDiscrete": spaces.MultiDiscrete([3, 2]),
    "MultiBinary": spaces.MultiBinary(3),
}

OBSERVATION_SPACES = {
    "Box float32": VECTOR,
    "Box float64": spaces.Box(-1.0, 1.0, (3,), np.float64),
    "Box 2x3": spaces.Box(-1.0, 1.0, (2, 3), np.float32),
    "Discrete": spaces.Discrete(5),
    "MultiDiscrete": spaces.MultiDiscrete([3, 4]),
    "MultiBinary": spaces.MultiBinary(4),
    "Dict": spaces.Dict({"vector": VECTOR, "choice": spaces.Discrete(3), "wide": spaces.Box(-1, 1, (2,), np.float64)}),
}

CHANNEL_LAST = spaces.Box(0, 255, (36, 36, 3), np.uint8)
SMALL_CNN: dict[str, Any] = {"features_extractor_kwargs": {"features_dim": 8}}


@pytest.mark.parametrize("observations", OBSERVATION_SPACES)
@pytest.mark.parametrize("actions", ACTION_SPACES)
def test_every_action_space_trains_on_every_observation_space(actions: str, observations: str) -> None:
    check_training(small_model(vec_env(lambda: AnySpacesEnv(OBSERVATION_SPACES[observations], ACTION_SPACES[actions]))))


@pytest.mark.parametrize("actions", ["Box", "Discrete"])
@pytest.mark.parametrize("images", [CHANNEL_FIRST, CHANNEL_LAST], ids=["channel first", "channel last"])
def test_images_train(images: spaces.Box, actions: str) -> None:
    env = vec_env(lambda: AnySpacesEnv(images, ACTION_SPACES[actions]))
    model = small_model(env, policy_kwargs=SMALL_CNN, n_steps=8)
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage) == (images is CHANNEL_LAST)
    check_training(model)


def test_images_train_with_an_extractor_for_each_step() -> None:
    env = vec_env(lambda: AnySpacesEnv(CHANNEL_FIRST))
    check_training(small_model(env, policy_kwargs=SMALL_CNN | {"share_features_extractor": False}, n_steps=8))


def test_a_dict_with_an_image_trains() -> None:
    observations = spaces.Dict({"image": CHANNEL_FIRST, "vector": VECTOR})
    model = small_model(
        vec_env(lambda: AnySpacesEnv(observations)),
        policy_kwargs=SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}},
        n_steps=8,
    )
    check_training(model)


def test_stacked_frames_train() -> None:
    check_training(small_model(VecFrameStack(vec_env(), n_stack=3)))


def test_stacked_image_frames_train() -> None:
    env = VecFrameStack(vec_env(lambda: AnySpacesEnv(CHANNEL_FIRST)), n_stack=2)
    model = small_model(env, policy_kwargs=SMALL_CNN, n_steps=8)
    assert model.observation_space.shape == (2, 36, 36)
    check_training(model)


@pytest.mark.parametrize("observations", ["Box float32", "Dict of vectors"])
def test_normalized_environments_train(observations: str) -> None:
    space = VECTOR if observations == "Box float32" else spaces.Dict({"one": VECTOR, "two": VECTOR})
    env = VecNormalize(vec_env(lambda: AnySpacesEnv(space, reward_scale=50.0)), gamma=0.99)
    model = small_model(env)
    check_training(model)
    assert np.abs(model.rollout_buffer.rewards).max() < 25.0, "the buffer holds what the wrapper makes of the rewards"


@pytest.mark.parametrize("key", [None, "ram"])
@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_integers_that_were_normalized_are_trained_on_as_the_policy_saw_them(dtype: type, key: str | None) -> None:
    """Not cut to whole numbers again, which is the type that VecNormalize leaves their space."""
    ram = spaces.Box(0, 255, (4,), dtype)
    space = ram if key is None else spaces.Dict({key: ram})
    model = small_model(VecNormalize(vec_env(lambda: AnySpacesEnv(space))), "MlpPolicy" if key is None else "MultiInputPolicy")
    check_training(model)
    seen: Any = model._last_obs
    train_once(model)
    stored: Any = model.rollout_buffer.observations
    seen, stored = (seen, stored) if key is None else (seen[key], stored[key])
    np.testing.assert_array_equal(stored[0], seen)
    assert (stored != np.round(stored)).any(axis=(1, 2)).all()


def test_discrete_actions_count_from_0_whatever_the_start_of_the_space_as_in_sb3() -> None:
    """SB3's environment checker says that it does not support these; nothing here hides that."""
    with pytest.raises(AssertionError, match=r"is not in Discrete\(3, start=7\)"):
        train_once(small_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Discrete(3, start=7)))))


def test_an_action_space_that_sb3_does_not_know_is_refused() -> None:
    with pytest.raises(AssertionError, match="only supports"):
        small_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Tuple([ACTIONS, ACTIONS]))), "MlpPolicy")


# Generalized state-dependent exploration


@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
@pytest.mark.parametrize("actions", ["Box", "Box asymmetric"])
@pytest.mark.parametrize("squash_output", [False, True])
def test_gsde_trains(squash_output: bool, actions: str, sde_sample_freq: int) -> None:
    # log_std -2: divergences between squashed Gaussians are taken before the squashing
    model = small_model(
        vec_env(lambda: AnySpacesEnv(VECTOR, ACTION_SPACES[actions])),
        use_sde=True,
        sde_sample_freq=sde_sample_freq,
        policy_kwargs=SMALL | {"squash_output": squash_output, "log_std_init": -2.0},
    )
    check_training(model)


@pytest.mark.parametrize("options", [{"full_std": False}, {"use_expln": True}], ids=["one std", "expln"])
def test_gsde_trains_with_its_options(options: dict[str, bool]) -> None:
    check_training(small_model(vec_env(), use_sde=True, policy_kwargs=SMALL | options))


@pytest.mark.parametrize(("sde_sample_freq", "expected"), [(-1, 1), (4, 1 + 4), (16, 1 + 1)])
def test_gsde_noise_is_sampled_as_often_as_asked(sde_sample_freq: int, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once at the start of a rollout of 16 steps, and then every so many steps, for each environment its own."""
    model = small_model(vec_env(n_envs=2), use_sde=True, sde_sample_freq=sde_sample_freq)
    calls = []
    monkeypatch.setattr(
        model.policy, "reset_noise", lambda n_envs=1, real=model.policy.reset_noise: (calls.append(n_envs), real(n_envs))
    )
    train_once(model)
    assert calls == [2] * expected


def test_squashed_actions_are_scaled_to_the_bounds() -> None:
    space = ACTION_SPACES["Box asymmetric"]
    env = vec_env(lambda: AnySpacesEnv(VECTOR, space))
    model = small_model(env, use_sde=True, policy_kwargs=SMALL | {"squash_output": True, "log_std_init": 2.0})
    sent = []
    step_async = model.env.step_async
    model.env.step_async = lambda actions: (sent.append(actions.copy()), step_async(actions))
    train_once(model)
    raw = model.rollout_buffer.actions
    assert np.abs(raw).max() <= 1.0
    np.testing.assert_allclose(np.array(sent), space.low + 0.5 * (raw + 1.0) * (space.high - space.low), atol=1e-6)
    assert np.array(sent)[..., 0].min() < -2.0, "the noise reaches beyond the part that clipping would have left"


def test_unsquashed_actions_are_clipped_and_the_buffer_keeps_what_was_drawn() -> None:
    space = ACTION_SPACES["Box asymmetric"]
    env = vec_env(lambda: AnySpacesEnv(VECTOR, space))
    model = small_model(env)
    sent = []
    step_async = model.env.step_async
    model.env.step_async = lambda actions: (sent.append(actions.copy()), step_async(actions))
    train_once(model)
    drawn = model.rollout_buffer.actions
    np.testing.assert_array_equal(np.array(sent), np.clip(drawn, space.low, space.high))
    assert (drawn[..., 1] < 0.5).any()
