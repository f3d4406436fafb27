"""The head whose outputs keep to the scale of the returns."""

import copy
import io
import pickle

import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_gae import MlpPolicy
from sb3_gae.networks.dense_policy import dense_value_network
from sb3_gae.networks.value_head import ValueHead
from sb3_gae.update.all_or_nothing import all_or_nothing


def new_head(bias: bool = True, dtype: th.dtype = th.float64) -> ValueHead:
    th.manual_seed(0)
    return ValueHead(nn.Linear(3, 1, bias=bias)).to(dtype)


def features(dtype: th.dtype = th.float64) -> th.Tensor:
    return th.randn(7, 3, generator=th.Generator().manual_seed(1), dtype=dtype)


def root_mean_square(values: th.Tensor) -> float:
    return values.double().square().mean().sqrt().item()


# --- Values ---


def test_a_new_head_is_the_layer_that_it_took_over() -> None:
    linear = nn.Linear(3, 1)
    head = ValueHead(linear)
    assert head.weight is linear.weight
    assert head.bias is linear.bias
    assert head.scale == 1.0
    assert th.equal(head(features(th.float32)), linear(features(th.float32)))


def test_outputs_are_those_of_the_layer_times_the_scale() -> None:
    head = new_head()
    head.scale.fill_(3.0)
    assert th.equal(head(features()), nn.functional.linear(features(), head.weight, head.bias) * 3.0)
    assert th.equal(head.unscaled()(features()) * 3.0, head(features()))


def test_the_unscaled_layer_shares_its_parameters() -> None:
    head = new_head()
    layer = head.unscaled()
    assert type(layer) is nn.Linear
    assert [id(parameter) for parameter in layer.parameters()] == [id(parameter) for parameter in head.parameters()]


@pytest.mark.parametrize("bias", [True, False], ids=["bias", "no bias"])
@given(targets=st.lists(arrays(float, 5, elements=st.floats(-1e3, 1e3)), min_size=1, max_size=5))
def test_rescaling_keeps_the_values(bias: bool, targets: list) -> None:
    head = new_head(bias)
    before = head(features()).detach()
    for batch in targets:
        head.update_scale(th.tensor(batch))
        assert head.scale > 0.0
        th.testing.assert_close(head(features()), before, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("size", [1e-30, 1e-10, 1.0, 1e10, 1e30])
def test_returns_of_any_size_give_that_size_as_scale(size: float, dtype: th.dtype) -> None:
    head = new_head(dtype=dtype)
    targets = size * th.tensor([3.0, -4.0, 0.0, 5.0], dtype=dtype)
    head.initialize_scale(targets)
    assert head.scale.item() == pytest.approx(size * 12.5**0.5, rel=1e-6)
    values = head(features(dtype)).detach()
    for _ in range(3):
        head.update_scale(targets)
        assert head.scale.item() == pytest.approx(size * 12.5**0.5, rel=1e-6)
    th.testing.assert_close(head(features(dtype)), values, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize(("factor", "scale"), [(1e-30, 1.0), (1e-8, 1e-8), (1e30, 1e30)])
def test_a_jump_over_many_orders_keeps_the_values(factor: float, scale: float) -> None:
    """And the scale is left where the weights would become so large that their squares are not finite."""
    head = new_head(dtype=th.float32)
    before = head(features(th.float32)).detach()
    head.update_scale(factor * th.ones(4))
    assert head.scale.item() == pytest.approx(scale, rel=1e-6)
    assert head.weight.square().square().isfinite().all()
    th.testing.assert_close(head(features(th.float32)), before, rtol=1e-4, atol=1e-6)


# --- The running scale ---


def test_the_scale_is_a_mean_square_that_forgets_at_the_rate_of_its_momentum() -> None:
    head = new_head()
    batches = [th.tensor([float(size), -float(size)]) for size in (5, 1, 2, 7, 3, 1, 4, 9, 2, 2, 6, 8, 1, 3, 5)]
    expected = 0.0
    for number, batch in enumerate(batches, start=1):
        head.update_scale(batch)
        weight = max(head.momentum, 1.0 / number)
        expected = (1.0 - weight) * expected + weight * root_mean_square(batch) ** 2
        assert head.scale.item() ** 2 == pytest.approx(expected, rel=1e-6)
    assert head.n_batches == len(batches) > 1.0 / head.momentum  # both ways of weighting were met


def test_while_there_are_few_batches_the_scale_is_their_plain_root_mean_square() -> None:
    head, generator = new_head(), th.Generator().manual_seed(0)
    batches = th.randn(4, 10, generator=generator).double()
    for batch in batches:
        head.update_scale(batch)
    assert head.scale.item() == pytest.approx(root_mean_square(batches))


def test_the_scale_is_initialized_before_the_first_update_only() -> None:
    head = new_head()
    weight = head.weight.clone()
    head.initialize_scale(th.tensor([6.0, -8.0]))
    assert head.scale.item() == pytest.approx(50**0.5)
    assert th.equal(head.weight, weight)  # nothing has used the values yet, so they may change
    head.update_scale(th.tensor([2.0]))
    scale = head.scale.clone()
    head.initialize_scale(th.tensor([1e6]))
    assert th.equal(head.scale, scale)


def test_returns_of_zero_leave_a_scale_of_one() -> None:
    head = new_head()
    before = head(features()).detach()
    head.initialize_scale(th.zeros(5))
    head.update_scale(th.zeros(5))
    assert head.scale == 1.0
    assert th.equal(head(features()), before)


@pytest.mark.parametrize("size", [1e-45, 1e-38, 1e-32])
def test_returns_too_small_to_divide_by_leave_a_scale_of_one(size: float) -> None:
    head = new_head(dtype=th.float32)
    before = head(features(th.float32)).detach()
    head.initialize_scale(th.full((5,), size))
    head.update_scale(th.full((5,), size))
    assert head.scale == 1.0
    assert th.equal(head(features(th.float32)), before)


def test_thousands_of_batches_without_reward_leave_finite_weights() -> None:
    head = new_head(dtype=th.float32)
    before = head(features(th.float32)).detach()
    for _ in range(3000):
        head.update_scale(th.zeros(2))
    assert th.isfinite(head.weight).all()
    assert head.scale > 0.0
    th.testing.assert_close(head(features(th.float32)), before, rtol=1e-3, atol=1e-5)


def test_returns_of_zero_later_on_shrink_the_scale_and_keep_the_values() -> None:
    head = new_head()
    head.initialize_scale(th.full((5,), 2.0))
    head.update_scale(th.full((5,), 2.0))
    before = head(features()).detach()
    for _ in range(100):
        head.update_scale(th.zeros(5))
    assert 0.0 < head.scale < 0.1
    th.testing.assert_close(head(features()), before, rtol=1e-10, atol=1e-12)


def test_targets_may_have_any_shape_and_are_not_modified() -> None:
    head, targets = new_head(), th.arange(6.0).double()
    before = targets.clone()
    head.initialize_scale(targets.reshape(2, 3))
    assert head.scale.item() == pytest.approx(root_mean_square(targets))
    head.update_scale(targets.reshape(3, 2))
    assert th.equal(targets, before)


# --- Weights that somebody has set ---


def set_weights(head: ValueHead) -> None:
    with th.no_grad():
        head.weight.add_(1.0)


def test_values_that_were_trained_before_stay_as_they_are() -> None:
    head = new_head()
    set_weights(head)
    # As of a file of the other layers alone
    head.load_state_dict({}, strict=False)
    before = head(features()).detach()
    head.initialize_scale(th.tensor([100.0]))
    assert head.scale == 1.0
    head.update_scale(th.tensor([100.0]))
    assert head.scale == 100.0
    th.testing.assert_close(head(features()), before, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("is_set", [True, False])
def test_a_file_knows_whether_weights_were_set(is_set: bool) -> None:
    head = new_head()
    if is_set:
        set_weights(head)
    for other in (by_torch_file(head), by_pickle(head), copy.deepcopy(head)):
        assert other.is_as_constructed is not is_set
        other.initialize_scale(th.tensor([100.0]))
        assert other.scale == (1.0 if is_set else 100.0)
    assert head.n_batches == 0


@pytest.mark.parametrize("how", ["load_from_vector", "copied parameters", "pretrained critic"])
def test_the_first_rollout_has_the_values_of_a_critic_that_was_trained_before(how: str) -> None:
    policy, other = small_policy(MlpPolicy), small_policy(MlpPolicy)
    with th.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1)
    if how == "load_from_vector":
        policy.load_from_vector(other.parameters_to_vector())
    elif how == "copied parameters":
        for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
            mine.data.copy_(theirs.data)
    else:
        optimizer = th.optim.Adam(policy.value_net.parameters(), 1e-3)
        policy.predict_values(th.randn(8, 2)).square().mean().backward()
        optimizer.step()
    before = policy.predict_values(th.ones(1, 2))
    policy.value_net.initialize_scale(th.tensor([100.0]))
    assert th.equal(policy.predict_values(th.ones(1, 2)), before)


def test_a_vector_of_parameters_means_the_same_in_every_policy() -> None:
    """Whatever the scales of the two."""
    source, target = small_policy(MlpPolicy), small_policy(MlpPolicy)
    source.value_net.update_scale(th.tensor([300.0, 400.0]))
    target.value_net.update_scale(th.tensor([0.03, 0.04]))
    observations = th.randn(8, 2)
    expected = source.predict_values(observations)
    vector = source.parameters_to_vector()
    plain = small_policy(ActorCriticPolicy)
    for policy in (target, plain, source):
        policy.load_from_vector(vector)
        th.testing.assert_close(policy.predict_values(observations), expected)
    plain.load_from_vector(plain.parameters_to_vector())
    target.load_from_vector(plain.parameters_to_vector())
    th.testing.assert_close(target.predict_values(observations), expected)


# --- Copies and files ---


def trained_head() -> ValueHead:
    head = new_head()
    head.update_scale(th.tensor([3.0, 4.0]))
    head.update_scale(th.tensor([30.0, 4.0]))
    return head


def by_pickle(head: ValueHead) -> ValueHead:
    return pickle.loads(pickle.dumps(head))


def by_torch_file(head: ValueHead) -> ValueHead:
    file = io.BytesIO()
    th.save(head.state_dict(), file)
    file.seek(0)
    other = new_head()
    other.load_state_dict(th.load(file, weights_only=True))
    return other


@pytest.mark.parametrize("duplicate", [copy.deepcopy, by_pickle, by_torch_file])
def test_a_copy_has_values_and_scale_of_its_own(duplicate) -> None:
    head = trained_head()
    before, other = head(features()).detach(), duplicate(head)
    assert th.equal(other(features()), before)
    assert th.equal(other.scale, head.scale)
    assert other.n_batches == head.n_batches == 2
    other.update_scale(th.tensor([1e6]))
    with th.no_grad():
        other.weight.zero_()
    assert th.equal(head(features()), before)


def test_the_state_of_a_plain_layer_loads_with_a_scale_of_one_that_stays() -> None:
    th.manual_seed(3)
    linear, head = nn.Linear(3, 1).double(), trained_head()
    state = linear.state_dict()
    head.load_state_dict(state)
    assert set(state) == {"weight", "bias"}  # the caller's dictionary is left alone
    assert th.equal(head(features()), linear(features()))
    head.initialize_scale(th.tensor([100.0]))
    assert th.equal(head(features()), linear(features()))


def test_the_state_of_a_plain_policy_loads_whole() -> None:
    policy, plain = small_policy(MlpPolicy), small_policy(ActorCriticPolicy)
    policy.value_net.update_scale(th.tensor([50.0]))
    policy.load_state_dict(plain.state_dict())
    observations = th.randn(4, 2)
    assert th.equal(policy.predict_values(observations), plain.predict_values(observations))


def test_missing_and_unknown_entries_are_still_refused() -> None:
    state = trained_head().state_dict()
    for wrong in ({k: v for k, v in state.items() if k != "weight"}, {**state, "shift": state["scale"]}):
        with pytest.raises(RuntimeError):
            new_head().load_state_dict(wrong)


def small_policy(policy_class: type[ActorCriticPolicy]) -> ActorCriticPolicy:
    return policy_class(spaces.Box(-1, 1, (2,)), spaces.Discrete(2), lambda _: 1e-3, net_arch=[3])


def test_policies_have_the_head_and_an_optimizer_that_holds_its_parameters() -> None:
    policy = small_policy(MlpPolicy)
    assert isinstance(policy.value_net, ValueHead)
    optimized = {id(parameter) for group in policy.optimizer.param_groups for parameter in group["params"]}
    assert optimized == {id(parameter) for parameter in policy.parameters()}


def test_the_dense_network_of_a_policy_gives_values_in_units_of_the_scale() -> None:
    policy = small_policy(MlpPolicy)
    policy.value_net.update_scale(th.tensor([50.0]))
    observations = th.randn(4, 2)
    values = dense_value_network(policy, observations).forward() * policy.value_net.scale
    th.testing.assert_close(values, policy.predict_values(observations).detach())


# --- Undone updates ---


@pytest.mark.parametrize("is_set", [False, True], ids=["as constructed", "set"])
@pytest.mark.parametrize("has_scale", [False, True])
def test_an_update_that_is_undone_leaves_no_trace(is_set: bool, has_scale: bool) -> None:
    policy = MlpPolicy(spaces.Box(-1.0, 1.0, (3,)), spaces.Discrete(2), lambda _: 1e-3)
    head = policy.value_net
    assert isinstance(head, ValueHead)
    if is_set:
        nn.init.zeros_(head.weight)
    if has_scale:
        head.scale.fill_(5.0)
    before = copy.deepcopy(head)
    with pytest.raises(KeyboardInterrupt), all_or_nothing(policy):
        head.update_scale(th.full((4,), 100.0))
        raise KeyboardInterrupt
    assert head.n_batches == 0
    assert th.equal(head.scale, before.scale) and th.equal(head.weight, before.weight)
    assert head.is_as_constructed is before.is_as_constructed
