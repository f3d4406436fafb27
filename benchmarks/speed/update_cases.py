"""Policy step, value fit and whole update on one rollout, each from the same start."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.speed import operations as ops
from benchmarks.speed.case import LIMIT, OURS, PEER, Case, Prepared
from benchmarks.speed.plan import Plan
from benchmarks.speed.product_cases import limit_of, network_sizes
from benchmarks.speed.rollouts import Rollout, rollout
from benchmarks.update_speed import Update, theirs
from sb3_gae.update.trust_region import StepRecord


def update_cases(plan: Plan) -> Iterator[Case]:
    """
    :param plan: with the sizes
    :return: steps and updates against batch and number of parameters
    """
    for varied, size, batch, hidden in network_sizes(plan):
        for part, contenders in _PARTS.items():
            for who, prepare in contenders.items():
                yield Case(part, varied, size, who, partial(_prepare, prepare, batch, hidden))


def _prepare(prepare: Callable[[Rollout], Prepared], batch: int, hidden: tuple[int, ...]) -> Prepared:
    return prepare(rollout(batch, hidden))


def rewind(of: Rollout) -> None:
    """
    Bring the model back to where it was, the draws of the curvature's samples included.

    :param of: a rollout
    """
    of.update.rewind()
    np.random.seed(0)


def step_policy(of: Rollout) -> list[StepRecord]:
    """
    :param of: a rollout
    :return: what was done
    """
    return [of.model._step_policy(of.batch, of.parameters)]


def fit_value(of: Rollout) -> list[StepRecord]:
    """
    :param of: a rollout
    :return: what was done in each step
    """
    return of.model._fit_value(of.batch, of.parameters).steps


def policy_products(of: Rollout, records: list[StepRecord]) -> ops.Products:
    """
    :param of: a rollout
    :param records: of the policy step
    :return: of that
    """
    (what,) = _solved(records)
    return ops.policy_step(of.policy_layers, len(of.batch), _curvature_batch(of), what)


def value_products(of: Rollout, records: list[StepRecord]) -> ops.Products:
    """
    :param of: a rollout
    :param records: of the value steps
    :return: of the fit
    """
    return ops.value_fit(of.value_layers, len(of.batch), _curvature_batch(of), _solved(records))


def _solved(records: list[StepRecord]) -> list[ops.Solved]:
    return [ops.solved(record.cg_status, record.cg_steps, record.trials) for record in records]


def _curvature_batch(of: Rollout) -> int:
    return min(len(of.batch), of.model.curvature_samples or len(of.batch))


class _Work:
    """What a part takes, read off one run of it."""

    def __init__(self, of: Rollout, with_policy: bool, with_value: bool):
        rewind(of)
        self.policy = step_policy(of) if with_policy else []
        self.value = fit_value(of) if with_value else []
        rewind(of)
        self.products = policy_products(of, self.policy) if with_policy else ops.Products()
        if with_value:
            self.products += value_products(of, self.value)

    @property
    def facts(self) -> dict[str, int]:
        records = [*self.policy, *self.value]
        return {
            "operations": ops.operations(self.products),
            "cg_steps": sum(record.cg_steps for record in records),
            "trials": sum(record.trials for record in records),
            "value_steps": len(self.value),
        }


def _ours(call: Callable[[Rollout], object], with_policy: bool, with_value: bool, of: Rollout) -> Prepared:
    return Prepared(lambda: call(of), lambda: rewind(of), facts=_Work(of, with_policy, with_value).facts)


def _limit(with_policy: bool, with_value: bool, of: Rollout) -> Prepared:
    work = _Work(of, with_policy, with_value)
    return limit_of(work.products)._replace(facts=work.facts)


def _peer(of: Rollout, **settings: int) -> Prepared:
    update = Update(theirs(of.model, **settings))
    return Prepared(update, update.rewind)


_PARTS: dict[str, dict[str, Callable[[Rollout], Prepared]]] = {
    "policy step": {
        OURS: partial(_ours, step_policy, True, False),
        # Without epochs of the value function, its update is the policy step
        PEER: partial(_peer, n_critic_updates=0),
        LIMIT: partial(_limit, True, False),
    },
    "value fit": {
        OURS: partial(_ours, fit_value, False, True),
        LIMIT: partial(_limit, False, True),
    },
    "update": {
        OURS: partial(_ours, lambda of: of.model.train(), True, True),
        PEER: _peer,
        LIMIT: partial(_limit, True, True),
    },
}
