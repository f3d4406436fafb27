"""Value fits that move parameters of the policy, too: against dense matrices, within both constraints, and in training."""

import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import (
    CHANNEL_FIRST,
    SMALL,
    VECTOR,
    AnySpacesEnv,
    KLProbe,
    differing,
    distribution_bits,
    small_model,
    train_once,
    vec_env,
)
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from oracles import ACTION_SPACES, OF_IMAGES, double_policy, fisher_matrix, jacobian, moved, state_of, training_batch
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_gae import TRPOGAE, SharedMlpPolicy
from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.distributions import snapshot
from sb3_gae.networks.parameters import flatten
from sb3_gae.update import shared_features, trust_region, value_step
from sb3_gae.update.conjugate_gradient import conjugate_gradient
from sb3_gae.update.kronecker import KroneckerPreconditioner
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.shared_features import ParameterGroups, SharedParameters, SharedStep, policy_step_radius, shared_parameters
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import ValueFitRecord, value_parameters, value_steps

EXACT = TrustRegionSettings(radius=0.05, cg_max_steps=400, cg_damping=0.05, max_scale=1.0)
DEFAULTS = TrustRegionSettings(radius=0.2, cg_max_steps=10, cg_damping=1e-2, cg_progress_tolerance=0.1, max_scale=1.0)

KINDS: dict[str, dict[str, Any]] = {
    "all layers": dict(action_space=ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=[5, 4]),
    "first layer": dict(
        action_space=ACTION_SPACES["Discrete"], policy_class=SharedMlpPolicy, net_arch=dict(pi=[5, 4], vf=[5, 3])
    ),
    "convolution": dict(action_space=ACTION_SPACES["Box"], **OF_IMAGES),
    "gSDE": dict(action_space=ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=[5], use_sde=True),
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def policy_of(kind: str, seed: int = 0) -> ActorCriticPolicy:
    return double_policy(**KINDS[kind], seed=seed)


def groups_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> ParameterGroups:
    of_policy = policy_parameters(policy, batch)
    of_value = value_parameters(policy, batch, of_policy)
    return ParameterGroups(of_policy, of_value, shared_parameters(policy, batch, of_policy))


def fit(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    limit: float | None,
    settings: TrustRegionSettings = EXACT,
    n_steps: int = 1,
    subset: th.Tensor | None = None,
) -> ValueFitRecord:
    """:param limit: of the divergence of the policy; None to leave the shared parameters alone"""
    groups = groups_of(policy, batch)
    shared = None if limit is None else SharedParameters(policy, groups, batch, limit, subset)
    return value_steps(policy, groups.of_value, batch, settings, n_steps, subset, shared)


def values_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    with th.no_grad():
        return policy.predict_values(batch.observations).squeeze(1)


def distribution_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> Any:
    with th.no_grad():
        return snapshot(policy.get_distribution(batch.observations))


def divergence(old: Any, new: Any) -> float:
    per_action = kl_divergence(old, new)
    return per_action.reshape(len(per_action), -1).sum(1).mean().item()


# --- Which parameters ---


def names_of(policy: nn.Module, parameters: list[th.Tensor]) -> set[str]:
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    return {names[id(parameter)] for parameter in parameters}


@pytest.mark.parametrize(
    ("net_arch", "n_shared"),
    [
        (None, 2),
        ([8], 1),
        ([], 0),
        (dict(pi=[8, 7], vf=[8, 7]), 2),
        (dict(pi=[8, 7], vf=[8, 6]), 1),
        (dict(pi=[8, 7, 6], vf=[8]), 1),
        (dict(pi=[8, 7], vf=[6, 7]), 0),
        (dict(pi=[8]), 0),
    ],
)
def test_the_layers_that_both_have_in_the_same_sizes_from_the_first_on_are_shared(net_arch: Any, n_shared: int) -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3, net_arch=net_arch)
    batch = training_batch(policy)
    groups = groups_of(policy, batch)
    parts = [f"mlp_extractor.policy_net.{2 * layer}.{part}" for layer in range(n_shared) for part in ("weight", "bias")]
    assert names_of(policy, groups.of_both) == set(parts)
    assert {id(parameter) for parameter in groups.of_both} <= {id(parameter) for parameter in groups.of_policy}
    assert not {id(parameter) for parameter in groups.of_both} & {id(parameter) for parameter in groups.of_value}
    features = th.randn(4, 3)
    hidden = features
    for layer in range(n_shared):
        hidden = th.tanh(policy.mlp_extractor.policy_net[2 * layer](hidden))
    for latent, net in zip(
        policy.mlp_extractor(features), (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net), strict=True
    ):
        assert th.equal(latent, net[2 * n_shared :](hidden))


def test_shared_layers_begin_as_sb3s_do() -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3)
    for linear, gain in [
        (policy.mlp_extractor.value_net[2], math.sqrt(2.0)),
        (policy.action_net, 0.01),
        (policy.value_net, 1),
    ]:
        product = linear.weight @ linear.weight.t()
        th.testing.assert_close(product, gain**2 * th.eye(len(product)), rtol=1e-4, atol=1e-5)
        assert not linear.bias.any()
    assert len({id(parameter) for group in policy.optimizer.param_groups for parameter in group["params"]}) == 9


# --- Against dense matrices ---


def dense_step(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    limit: float,
    settings: TrustRegionSettings,
    subset: th.Tensor | None = None,
) -> th.Tensor:
    """The problem with two ellipsoids, solved by NumPy for the parameters of the value alone and then the shared ones."""
    groups = groups_of(policy, batch)
    everything = slice(None) if subset is None else subset
    rows = jacobian(lambda: policy.predict_values(batch.observations), [*groups.of_value, *groups.of_both])
    errors = batch.value_targets - values_of(policy, batch)
    variance = errors.square().mean()
    gradient = (rows.t() @ errors / len(batch) / variance).numpy()
    curvature_rows = rows[everything]
    hessian = (curvature_rows.t() @ curvature_rows / len(curvature_rows) / variance).numpy()
    fisher = np.zeros_like(hessian)
    n_own = sum(parameter.numel() for parameter in groups.of_value)
    fisher[n_own:, n_own:] = fisher_matrix(policy, batch.observations[everything], groups.of_both).numpy()
    damping = settings.cg_damping / batch.value_targets.square().mean().item()
    metric = hessian + settings.radius / limit * fisher + damping * np.eye(len(hessian))
    step = np.linalg.solve(metric, gradient)
    curvature = step @ hessian @ step
    longest = min(
        math.sqrt(2.0 * settings.radius / curvature),
        math.sqrt(2.0 * limit / (step @ fisher @ step)),
        settings.max_scale * (gradient @ step) / curvature,
    )
    return th.as_tensor(longest * step)


def assert_step_is(
    expected: th.Tensor, policy: ActorCriticPolicy, batch: TrainingBatch, limit: float, settings: Any, subset: Any = None
) -> None:
    groups = groups_of(policy, batch)
    parameters = [*groups.of_value, *groups.of_both]
    before = flatten(parameters)
    (record,) = fit(policy, batch, limit, settings, subset=subset).steps
    assert record.accepted
    assert (flatten(parameters) - before - expected * record.length).norm() <= 2e-4 * record.length * expected.norm()


@each_kind
@pytest.mark.parametrize(
    ("radius", "limit"),
    [(1e-3, 1e-2), (0.5, 1e-5), (0.05, 1e-3), (1e6, 1e4)],
    ids=["values on the radius", "policy on the limit", "both near", "minimum within both"],
)
def test_steps_are_those_of_dense_matrices(kind: str, radius: float, limit: float) -> None:
    policy = policy_of(kind)
    batch = training_batch(policy)
    settings = replace(EXACT, radius=radius)
    assert_step_is(dense_step(policy, batch, limit, settings), policy, batch, limit, settings)


@pytest.mark.parametrize("kind", ["all layers", "convolution"])
def test_both_curvatures_may_come_from_a_subset(kind: str) -> None:
    policy, subset = policy_of(kind), th.tensor([1, 2, 3, 5, 8, 13, 21])
    batch = training_batch(policy)
    settings = replace(EXACT, radius=1e-3)
    expected = dense_step(policy, batch, 1e-3, settings, subset)
    assert not th.allclose(expected, dense_step(policy, batch, 1e-3, settings), rtol=0.01)
    assert_step_is(expected, policy, batch, 1e-3, settings, subset)


@pytest.mark.parametrize("kind", ["all layers", "first layer"])
@pytest.mark.parametrize("limit", [1e-2, None], ids=["joint", "frozen"])
def test_dense_and_autograd_steps_are_the_same(kind: str, limit: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [policy_of(kind), policy_of(kind)]
    batch = training_batch(policies[0])
    # Far from the radius: on it rounding would decide which trial is accepted
    settings = replace(EXACT, cg_damping=1.0, radius=10.0)
    fast = fit(policies[0], batch, limit, settings, n_steps=3)
    let_everything_be_differentiated_twice(monkeypatch)
    slow = fit(policies[1], batch, limit, settings, n_steps=3)
    assert len(fast.steps) == len(slow.steps) == 3
    for one, other in zip(policies[0].parameters(), policies[1].parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def let_everything_be_differentiated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(value_step, "has_dense_value", lambda policy, parameters: False)
    monkeypatch.setattr(shared_features, "has_dense_policy", lambda policy, parameters: False)


@pytest.mark.parametrize("seed", range(3))
def test_each_preconditioner_brings_a_few_products_nearer_to_the_solution(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problems = []
    real = value_step.trust_region_step
    monkeypatch.setattr(value_step, "trust_region_step", lambda *args: (problems.append(args), real(*args))[1])
    arguments: dict[str, Any] = dict(n_inputs=8, policy_class=SharedMlpPolicy, net_arch=[24, 16], seed=seed)
    policy = double_policy(ACTION_SPACES["Box"], **arguments)
    batch, start = training_batch(policy, 600), state_of(policy)
    fit(policy, batch, 1e-4, DEFAULTS)
    # The products are those of the parameters before the step
    policy.load_state_dict(start)
    ((problem, _),) = problems
    coordinates, damping = problem.constraint.coordinates, 1e-2

    def operator(vector: th.Tensor) -> th.Tensor:
        return trust_region._metric(problem, DEFAULTS, vector) + damping * vector

    def gap(precondition: Any, n_products: int = 3) -> float:
        """How far the quadratic is from its maximum, as a part of that."""
        by = None if precondition is None else lambda vector: precondition(vector, damping)
        error = conjugate_gradient(operator, problem.gradient, n_products, preconditioner=by).solution - solution
        return float(error.dot(operator(error)) / solution.dot(problem.gradient))

    solution = conjugate_gradient(operator, problem.gradient, 500, relative_tolerance=1e-12).solution
    scaling = trust_region._scaling(problem, DEFAULTS, coordinates)
    assert gap(problem.precondition) < 0.5 * gap(scaling)
    assert gap(scaling) < 0.1 * gap(None)


def test_the_preconditioner_of_one_layer_knows_what_another_network_adds() -> None:
    """Values and logits of one layer each, on the same features: the sum of their curvatures is inverted exactly."""
    policy = double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[3], vf=[]))
    network = value_step.dense_value_network(policy, training_batch(policy).observations)
    network.forward()
    features = th.cat([network.blocks[0], th.ones(network.batch_size, 1)], dim=1)
    curvature = features.t() @ features / network.batch_size
    (linear, _) = network.layers[0]
    preconditioner = KroneckerPreconditioner(network, th.ones(network.batch_size, 1).double(), {linear: th.tensor([[2.5]])})
    vector = th.randn(4).double()
    solution = th.linalg.solve(3.0 * (1.0 + 2.5) * curvature + 0.1 * th.eye(4), vector)
    th.testing.assert_close(preconditioner(vector, 3.0, 0.1), solution)


# --- Both constraints ---


@given(
    kind=st.sampled_from(list(KINDS)),
    seed=st.integers(0, 1000),
    log_radius=st.floats(-4, 1),
    log_limit=st.floats(-6, 0),
    n_steps=st.integers(1, 4),
)
def test_both_true_constraints_hold(kind: str, seed: int, log_radius: float, log_limit: float, n_steps: int) -> None:
    policy = policy_of(kind, seed)
    batch = training_batch(policy, seed=seed)
    settings, limit = replace(DEFAULTS, radius=10**log_radius), 10**log_limit
    old, before = distribution_of(policy, batch), values_of(policy, batch)
    variance = (before - batch.value_targets).square().mean().item()
    record = fit(policy, batch, limit, settings, n_steps)
    used = divergence(old, distribution_of(policy, batch))
    assert used <= limit * (1 + 1e-9)
    assert record.policy_kl == pytest.approx(used, rel=1e-9, abs=1e-15)
    assert all(step.divergence <= settings.radius for step in record.steps)
    after = values_of(policy, batch)
    th.testing.assert_close(record.values_after, after)
    assert (after - batch.value_targets).square().mean().item() < variance
    if n_steps == 1:
        change = (after - before).square().mean().item() / (2.0 * variance)
        assert record.steps[0].divergence == pytest.approx(change, rel=1e-6)


def test_each_step_of_a_fit_gets_an_equal_part_of_the_way_that_is_left() -> None:
    policy = policy_of("all layers")
    batch = training_batch(policy)
    old, limit = distribution_of(policy, batch), 1e-2
    shared = SharedParameters(policy, groups_of(policy, batch), batch, limit)
    assert shared.divergence() == 0.0
    assert [shared.radius(steps_left) for steps_left in (1, 5)] == pytest.approx([limit, limit / 25])
    with th.no_grad():
        policy.mlp_extractor.policy_net[0].weight.add_(0.2)
    used = divergence(old, distribution_of(policy, batch))
    assert 0.1 * limit < used < 0.9 * limit
    assert shared.divergence() == pytest.approx(used)
    assert shared.radius(2) == pytest.approx(((math.sqrt(limit) - math.sqrt(used)) / 2) ** 2)
    for limit in (used * (1.0 + 1e-9), used, 0.5 * used):
        shared._limit = limit
        assert shared.radius(2) == 0.0


def test_what_the_policy_alone_depends_on_stays() -> None:
    for kind in KINDS:
        policy = policy_of(kind)
        batch = training_batch(policy)
        groups, before = groups_of(policy, batch), state_of(policy)
        fit(policy, batch, 1e-2, DEFAULTS, n_steps=3)
        allowed = {id(parameter) for parameter in [*groups.of_value, *groups.of_both]}
        named = dict(policy.named_parameters(remove_duplicate=False))
        assert {id(named[name]) for name in moved(before, policy)} == allowed


@each_kind
def test_where_features_matter_the_error_falls_further_than_with_frozen_ones(kind: str) -> None:
    errors = []
    for limit in (None, 1e-3):
        policy = policy_of(kind)
        batch = training_batch(policy, 200)
        inputs = batch.observations.double().flatten(1)
        signal = th.sin(2.0 * (inputs - inputs.mean(0)) / inputs.std(0))[:, 0]
        batch = replace(batch, value_targets=3.0 * signal)
        fit(policy, batch, limit, DEFAULTS, n_steps=5)
        errors.append((values_of(policy, batch) - batch.value_targets).square().mean().item())
    assert errors[1] < errors[0]


# --- What is left when a step fails ---


@each_kind
def test_a_rejected_fit_changes_no_bit(kind: str) -> None:
    policy = policy_of(kind)
    batch = training_batch(policy)
    before = state_of(policy)
    record = fit(policy, batch, 1e12, replace(DEFAULTS, radius=1e12, max_scale=1e9, max_trials=2), n_steps=4)
    assert [step.accepted for step in record.steps] == [False, False], "with the shared parameters, and without"
    assert record.policy_kl == 0.0
    assert not moved(before, policy)


@each_kind
@pytest.mark.parametrize("bad", [math.inf, math.nan])
def test_without_room_for_the_policy_the_values_own_parameters_go_on(
    kind: str, bad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the divergence of every trial is bad: the first step fails, and the others are those of a fit without it."""
    policies = [policy_of(kind), policy_of(kind)]
    batch = training_batch(policies[0])
    expected = fit(policies[0], batch, None, DEFAULTS, n_steps=2)
    real = SharedParameters.step

    def far_away(*args: Any) -> SharedStep:
        step = real(*args)
        return replace(step, constraint=replace(step.constraint, divergence=lambda: bad))

    monkeypatch.setattr(SharedParameters, "step", far_away)
    record = fit(policies[1], batch, 1e-3, DEFAULTS, n_steps=3)
    assert record.steps[0].accepted is False
    assert record.steps[1:] == expected.steps
    assert record.policy_kl == 0.0
    assert differing(state_of(policies[0]), state_of(policies[1])) == []


def test_a_limit_that_is_used_up_leaves_the_fit_of_frozen_features() -> None:
    policies = [policy_of("all layers"), policy_of("all layers")]
    batch = training_batch(policies[0])
    expected = fit(policies[0], batch, None, DEFAULTS, n_steps=3)
    assert fit(policies[1], batch, 0.0, DEFAULTS, n_steps=3).steps == expected.steps
    assert differing(state_of(policies[0]), state_of(policies[1])) == []


def test_distribution_parameters_that_are_not_finite_are_infinitely_far() -> None:
    policy = policy_of("all layers")
    batch = training_batch(policy)
    shared = SharedParameters(policy, groups_of(policy, batch), batch, 1e-3)
    with th.no_grad():
        policy.mlp_extractor.policy_net[0].weight.fill_(math.nan)
    assert shared.divergence() == math.inf


# --- In training ---


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.25, 0.81])
def test_ways_in_the_policys_metric_add_up_to_the_whole(fraction: float) -> None:
    way = math.sqrt(policy_step_radius(0.02, fraction)) + math.sqrt(fraction * 0.02)
    assert way == pytest.approx(math.sqrt(0.02))


def observations_of(name: str) -> spaces.Space:
    return {
        "image": CHANNEL_FIRST,
        "dict": spaces.Dict({"image": CHANNEL_FIRST, "vector": VECTOR}),
    }.get(name, VECTOR)


SETTINGS: dict[str, dict[str, Any]] = {
    "vector": dict(policy="SharedMlpPolicy"),
    "gSDE": dict(policy="SharedMlpPolicy", use_sde=True),
    "image": dict(policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}}),
    "dict": dict(policy="MultiInputPolicy", policy_kwargs=SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}}),
    "few samples for curvature": dict(policy="SharedMlpPolicy", curvature_samples=8),
    "discrete": dict(policy="SharedMlpPolicy"),
}


def shared_model(name: str = "vector", **kwargs: Any) -> TRPOGAE:
    actions = {"action_space": spaces.Discrete(4)} if name == "discrete" else {}
    env = vec_env(lambda: AnySpacesEnv(observations_of(name), **actions))
    return small_model(env, **dict(vf_kl_fraction=0.2) | SETTINGS[name] | kwargs)


@pytest.mark.parametrize("name", SETTINGS)
def test_an_update_keeps_to_the_parts_of_the_radius_that_are_meant_for_its_steps(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = shared_model(name)
    fit_value, measured = TRPOGAE._fit_value, []

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        old = distribution_of(self.policy, batch)
        record = fit_value(self, batch, parameters)
        measured.append(divergence(old, distribution_of(self.policy, batch)))
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    for _ in range(3):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert 0.0 < logged["train/kl_divergence_loss"] <= policy_step_radius(model.target_kl, 0.2)
        assert 0.0 < measured[-1] <= 0.2 * model.target_kl
        assert logged["train/vf_policy_kl"] == pytest.approx(measured[-1], rel=1e-3, abs=1e-7)
        assert probe.kl() <= 1.1 * model.target_kl
        assert logged["train/vf_steps"] >= 1 and logged["train/vf_kl_divergence"] <= model.vf_trust_region


@pytest.mark.parametrize("name", SETTINGS)
def test_with_a_fraction_of_0_the_value_fit_leaves_the_action_distribution_alone(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = shared_model(name, vf_kl_fraction=0.0)
    fit_value, seen = TRPOGAE._fit_value, []

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        before = distribution_bits(self.policy, batch.observations)
        record = fit_value(self, batch, parameters)
        after = distribution_bits(self.policy, batch.observations)
        seen.append(all(th.equal(old, new) for old, new in zip(before, after, strict=True)))
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    logged = train_once(model)
    assert seen == [True]
    assert "train/vf_policy_kl" not in logged
    assert policy_step_radius(model.target_kl, 0.2) < logged["train/kl_divergence_loss"] <= model.target_kl


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
def test_without_shared_parameters_the_fraction_changes_no_bit(policy: Any) -> None:
    states, logs = [], []
    for fraction in (0.0, 0.3):
        model = small_model(policy=policy, env=vec_env(), policy_kwargs=SMALL, vf_kl_fraction=fraction)
        logs.append([train_once(model) for _ in range(3)])
        states.append(state_of(model.policy))
    assert differing(*states) == []
    for one, other in zip(*logs, strict=True):
        assert {name: value for name, value in one.items() if name.startswith("train/")} == {
            name: value for name, value in other.items() if name.startswith("train/")
        }


def test_a_shared_policy_learns() -> None:
    model = TRPOGAE("SharedMlpPolicy", "CartPole-v1", n_steps=1024, gae_lambda=0.98, vf_kl_fraction=0.05, seed=1)
    model.learn(1024)
    first = np.mean([episode["r"] for episode in model.ep_info_buffer])
    explained = [train_once(model)["train/explained_variance_after"] for _ in range(9)]
    last = np.mean([episode["r"] for episode in list(model.ep_info_buffer)[-10:]])
    assert first < 40.0 and last > 100.0
    assert max(explained) > 0.5


def test_a_shared_model_comes_back_and_goes_on_as_if_it_had_not_stopped() -> None:
    model = shared_model()
    train_once(model)
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    loaded = TRPOGAE.load(file)
    assert type(loaded.policy) is SharedMlpPolicy and loaded.vf_kl_fraction == 0.2
    assert loaded.policy.mlp_extractor.value_net[0] is loaded.policy.mlp_extractor.policy_net[0]
    states = []
    for each in (model, loaded):
        each.set_env(vec_env())
        each.set_random_seed(7)
        assert "train/vf_policy_kl" in train_once(each)
        states.append(state_of(each.policy))
    assert differing(*states) == []


def test_a_shared_policy_comes_back_on_its_own(tmp_path: Any) -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3, **SMALL)
    policy.save(tmp_path / "policy")
    loaded = SharedMlpPolicy.load(tmp_path / "policy")
    assert differing(state_of(policy), state_of(loaded)) == []
    assert loaded.mlp_extractor.value_net[0] is loaded.mlp_extractor.policy_net[0]


@pytest.mark.parametrize(("name", "value"), [("vf_optimizer", "adam"), ("baseline", "time"), ("value_fit_first", True)])
def test_a_fraction_needs_a_trust_region_fit_after_the_policy_step(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"`vf_kl_fraction` = 0.1 .* leave out `{name}` = {value!r}"):
        small_model(vec_env(), vf_kl_fraction=0.1, **{name: value})
    small_model(vec_env(), vf_kl_fraction=0.0, **{name: value})
