"""Bad numbers in an update are refused with words that say which, and what has moved is moved back."""

import dataclasses
import math
from typing import Any

import pytest
import torch as th
from bad_numbers import BAD, check_refused
from envs_for_tests import differing, optimizer_state, short_model, state_of, train_once

import sb3_gae.update.policy_step
import sb3_gae.update.value_step
from sb3_gae import MlpPolicy
from sb3_gae.checks import is_about_numbers
from sb3_gae.update.shared_parameters import SharedParameters


def spoil(monkeypatch: pytest.MonkeyPatch, step: Any, **changes: Any) -> None:
    """Let the problem of a step arrive at its solver with something changed."""
    real = step.trust_region_step

    def spoilt(problem: Any, settings: Any) -> Any:
        changed = {name: change(getattr(problem, name)) for name, change in changes.items()}
        return real(dataclasses.replace(problem, **changed), settings)

    monkeypatch.setattr(step, "trust_region_step", spoilt)


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_gradient_of_the_policy_is_refused(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model = short_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, gradient=lambda gradient: gradient.index_fill(0, th.tensor([3]), bad))
    check_refused(model, "gradient of the policy contains NaN or infinity")


def test_a_bad_curvature_of_the_policy_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = short_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, curvature=lambda product: lambda vector: product(vector) * math.nan)
    check_refused(model, "curvature product of the policy contains NaN or infinity")


@pytest.mark.parametrize("what", ["gradient", "curvature product"])
def test_a_bad_value_step_is_refused_and_undoes_the_policy_step_before_it(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = short_model()
    train_once(model)
    if what == "gradient":
        spoil(monkeypatch, sb3_gae.update.value_step, gradient=lambda gradient: gradient * math.inf)
    else:
        spoil(monkeypatch, sb3_gae.update.value_step, curvature=lambda product: lambda vector: product(vector) * math.nan)
    check_refused(model, f"{what} of the value function contains NaN or infinity")


def test_a_bad_gradient_of_adam_is_refused_and_undoes_the_policy_step_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    model = short_model(vf_optimizer="adam", batch_size=4)
    train_once(model)
    optimizer = optimizer_state(model)
    losses = []

    def third_is_bad(*args: Any, **kwargs: Any) -> th.Tensor:
        losses.append(real(*args, **kwargs))
        return losses[-1] * (math.nan if len(losses) == 3 else 1.0)

    real = th.nn.functional.mse_loss
    monkeypatch.setattr(th.nn.functional, "mse_loss", third_is_bad)
    check_refused(model, "gradient of the value function contains NaN or infinity")
    assert len(losses) == 3
    assert differing(optimizer, optimizer_state(model)) == []


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_update_that_is_interrupted_is_undone(error: type[BaseException], vf_optimizer: str) -> None:
    model = short_model(vf_optimizer=vf_optimizer)
    train_once(model)
    fit_value, before, optimizer = model._fit_value, state_of(model.policy), optimizer_state(model)
    moved = []

    def interrupted(*args: Any) -> None:
        fit_value(*args)
        moved.extend(differing(before, state_of(model.policy)))
        raise error

    model._fit_value = interrupted  # type: ignore[method-assign, assignment]
    with pytest.raises(error):
        train_once(model)
    assert {"action_net.weight", "value_net.weight"} <= set(moved)
    assert differing(before, state_of(model.policy)) == []
    assert differing(optimizer, optimizer_state(model)) == []
    model._fit_value = fit_value  # type: ignore[method-assign]
    assert train_once(model)["train/n_updates"] == 2


@pytest.mark.parametrize("error", [th.linalg.LinAlgError, ZeroDivisionError, OverflowError])
def test_linear_algebra_that_breaks_down_is_a_numerical_error(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks_down(vector: th.Tensor) -> th.Tensor:
        raise error("no such decomposition")

    model = short_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, curvature=lambda product: breaks_down)
    check_refused(model, "linear algebra of the update broke down: no such decomposition")


@pytest.mark.parametrize("validate_args", [True, False], ids=["torch refuses it", "as after torch.compile"])
def test_a_trial_without_a_distribution_is_a_trial_that_failed(validate_args: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With such a radius the first steps make standard deviations of 0. Shorter ones follow, and no error."""
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", validate_args)
    refusals = []

    class Watched(MlpPolicy):
        def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Any:
            try:
                distribution = super()._get_action_dist_from_latent(latent_pi)
            except ValueError:
                refusals.append(True)
                raise
            if not th.all(distribution.distribution.stddev > 0.0):
                refusals.append(False)
            return distribution

    search = {"line_search_shrinking_factor": 0.5, "line_search_max_iter": 60}
    model = short_model(policy=Watched, target_kl=1e6, **search)
    logged = train_once(model)
    assert set(refusals) == {validate_args}
    assert logged["train/is_line_search_success"] == 1.0 and logged["train/line_search_trials"] > len(refusals)


@pytest.mark.parametrize("owner", [sb3_gae.update.policy_step._SurrogateAndDivergence, SharedParameters])
def test_an_error_of_the_network_itself_ends_an_update(owner: type, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a trial of the policy step, and where the value fit looks how far it has moved what both share."""
    shared = {"vf_kl_fraction": 0.1, "policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.CELU}}
    model = short_model(policy="SharedMlpPolicy", **shared)
    train_once(model)
    before, method, asked = state_of(model.policy), "divergence" if owner is SharedParameters else "__call__", []
    real = getattr(owner, method)
    monkeypatch.setattr(owner, method, lambda self: (asked.append(True), real(self))[1])

    def fail(module: Any, inputs: Any, outputs: th.Tensor) -> None:
        if asked:
            asked.clear()
            raise ValueError("too many values to unpack")

    model.policy.action_net.register_forward_hook(fail)
    with pytest.raises(ValueError, match="too many values to unpack"):
        train_once(model)
    assert differing(before, state_of(model.policy)) == []


def test_which_errors_are_about_numbers() -> None:
    """Those of a distribution that torch refuses to make, and any where a parameter that is trained has gone bad."""
    good, bad = th.nn.Parameter(th.zeros(2)), th.nn.Parameter(th.tensor([0.0, math.inf]))
    with pytest.raises(ValueError, match="parameter loc") as refused:
        th.distributions.Normal(th.tensor(math.nan), 1.0)
    with pytest.raises(ValueError, match="invalid literal") as other:
        int("x")
    assert is_about_numbers(refused.value, [good])
    assert is_about_numbers(other.value, [good, bad])
    assert not is_about_numbers(other.value, [good, bad.requires_grad_(False)])
    assert not is_about_numbers(ValueError("never raised"), [good])
