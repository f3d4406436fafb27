"""What must hold of every step of every update, measured from outside of the update."""

import copy
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch as th

import sb3_gae.update.policy_step
import sb3_gae.update.value_step
from sb3_gae import TRPOGAE
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.trust_region import LocalProblem, StepRecord, TrustRegionSettings, trust_region_step

# Divergences are measured here in double precision, and in the update in single
_TOLERANCE = 1e-3


class Watch:
    """
    :param model: whose updates are watched, see :func:`watched`
    """

    def __init__(self, model: TRPOGAE):
        self.model = model
        #: steps by what they were and what became of them
        self.counts: Counter[str] = Counter()
        #: in words; none is what one hopes for
        self.violations: list[str] = []

    def step(self, problem: LocalProblem, settings: TrustRegionSettings) -> StepRecord:
        """In the place of the real one."""
        batch = training_batch(self.model.rollout_buffer, self.model.action_space)
        before, old = [parameter.detach().clone() for parameter in problem.parameters], self._state(batch.observations)
        record = trust_region_step(problem, settings)
        what = problem.name
        self.counts[f"{what}: {'accepted' if record.accepted else 'rejected'}"] += 1
        same = all(th.equal(one, other) for one, other in zip(before, problem.parameters, strict=True))
        self._expect(record.accepted or same, f"{what}: a rejected step moved parameters")
        self._expect(all(bool(tensor.isfinite().all()) for tensor in problem.parameters), f"{what}: not finite any more")
        divergence = self._divergence(what, old, self._state(batch.observations), batch.value_targets)
        self._expect(
            divergence <= settings.radius * (1.0 + _TOLERANCE) + 1e-9, f"{what}: {divergence} is more than {settings.radius}"
        )
        return record

    def _expect(self, holds: bool, otherwise: str) -> None:
        if not holds:
            self.violations.append(f"update {self.model._n_updates}: {otherwise}")

    @th.no_grad()
    def _state(self, observations: Any) -> tuple[list[Any], th.Tensor]:
        policy = self.model.policy
        found = copy.copy(policy.get_distribution(observations)).distribution
        values = policy.predict_values(observations).flatten().double()
        return found if isinstance(found, list) else [found], values

    @staticmethod
    def _divergence(what: str, old: Any, new: Any, targets: th.Tensor) -> float:
        if what == "policy":
            parts = [th.distributions.kl_divergence(one, other) for one, other in zip(old[0], new[0], strict=True)]
            return float(sum(part.reshape(len(part), -1).sum(dim=1).double().mean() for part in parts))
        variance = (old[1] - targets.double()).square().mean()
        change = (new[1] - old[1]).square().mean()
        # Values that are their targets have no variance, and must not move
        return float(change / (2.0 * variance)) if change > 0.0 else 0.0


@contextmanager
def watched(model: TRPOGAE) -> Iterator[Watch]:
    """
    :param model: that trains in the block
    :return: what was seen
    """
    watch = Watch(model)
    with ExitStack() as patches:
        for module in (sb3_gae.update.policy_step, sb3_gae.update.value_step):
            patches.enter_context(mock.patch.object(module, "trust_region_step", watch.step))
        yield watch
