"""The Optuna sampler and converter, without training."""

import inspect

import optuna
import pytest

from sb3_gae import TRPOGAE
from sb3_gae.zoo import convert_trpo_gae_params, sample_trpo_gae_params


def sample_trials(n_actions: int, n_envs: int, n_trials: int = 30) -> list[tuple[dict, optuna.trial.FrozenTrial]]:
    """Draw trials at random.

    :return: for each, what the sampler returned and what the study stored
    """
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    sampled = []

    def objective(trial: optuna.Trial) -> float:
        sampled.append(sample_trpo_gae_params(trial, n_actions, n_envs, {}))
        return 0.0

    study.optimize(objective, n_trials=n_trials)
    return list(zip(sampled, study.trials, strict=True))


@pytest.mark.parametrize("n_actions", [0, 3])
@pytest.mark.parametrize("n_envs", [1, 8])
def test_converting_a_stored_trial_gives_what_was_sampled(n_actions: int, n_envs: int) -> None:
    for sampled, trial in sample_trials(n_actions, n_envs):
        stored = dict(trial.params)
        assert convert_trpo_gae_params(stored) == sampled
        assert stored == trial.params  # left alone


@pytest.mark.parametrize("n_actions", [0, 3])
def test_sampled_names_are_arguments_of_the_algorithm(n_actions: int) -> None:
    accepted = inspect.signature(TRPOGAE).parameters.keys()
    for sampled, _ in sample_trials(n_actions, n_envs=2):
        assert sampled.keys() <= accepted
        assert ("log_std_init" in sampled["policy_kwargs"]) == (n_actions > 0)


@pytest.mark.parametrize("n_envs", [1, 2, 6, 16, 1024])
def test_batches_keep_their_size_whatever_the_number_of_environments(n_envs: int) -> None:
    sizes = [sampled["n_steps"] * n_envs for sampled, _ in sample_trials(0, n_envs)]
    # Powers of two can miss the range by half a power where the number of environments is none
    assert min(sizes) >= 512 / 2**0.5
    assert max(sizes) <= 8192 * 2**0.5
    assert len(set(sizes)) > 1


def test_a_sampled_batch_is_in_steps_whatever_the_settings_have() -> None:
    settings = {"n_envs": 20, "n_episodes": 1, "n_steps": 1000}
    assert all((settings | sampled)["n_episodes"] is None for sampled, _ in sample_trials(0, 20))


def test_sampled_values_cover_their_ranges() -> None:
    trials = sample_trials(3, 4, n_trials=200)
    assert {name for _, trial in trials for name in trial.params} == {
        *("n_steps_pow", "one_minus_gamma", "one_minus_gae_lambda", "value_lambda", "target_kl", "cg_max_steps"),
        *("vf_trust_region", "vf_steps", "net_arch", "activation_fn", "log_std_init"),
    }
    assert {sampled["value_lambda"] for sampled, _ in trials} == {None, 1.0}
    assert {tuple(sampled["policy_kwargs"]["net_arch"]["vf"]) for sampled, _ in trials} >= {(100, 50, 25), (64, 64)}
    for sampled, trial in trials:
        assert 0.95 <= sampled["gamma"] < 1
        assert 0.7 <= sampled["gae_lambda"] < 1
        assert sampled["gamma"] == trial.user_attrs["gamma"]
        assert sampled["n_steps"] == trial.user_attrs["n_steps"]
