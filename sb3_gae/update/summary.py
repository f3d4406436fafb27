"""What an update did, as numbers for the log."""

import numpy as np
import torch as th

from sb3_gae.estimators.measures import explained_variance
from sb3_gae.update.trust_region import StepRecord
from sb3_gae.update.value_step import ValueFitRecord


def update_summary(policy_record: StepRecord, value_record: ValueFitRecord, value_targets: th.Tensor) -> dict[str, float]:
    """
    :param policy_record: of the policy step
    :param value_record: of the value fit
    :param value_targets: of the value fit, shape (B,)
    :return: sb3-contrib's names where it has one; the ``vf_`` entries only after trust-region steps, and
        ``vf_policy_kl`` only where these may have moved the policy
    """
    # Double precision: squares of values around 1e30 leave the range of single
    tensors = (value_record.values_before, value_record.values_after, value_targets)
    before, after, targets = (tensor.cpu().double().numpy() for tensor in tensors)
    summary = {
        "policy_objective": policy_record.objective_after,
        "kl_divergence_loss": policy_record.divergence,
        "is_line_search_success": float(policy_record.accepted),
        "line_search_trials": policy_record.trials,
        "cg_steps": policy_record.cg_steps,
        "value_loss": float(np.mean(np.square(after - targets))),
        "explained_variance": explained_variance(before, targets),
        "explained_variance_after": explained_variance(after, targets),
    }
    if value_record.steps:
        summary["vf_steps"] = sum(step.accepted for step in value_record.steps)
        summary["vf_kl_divergence"] = max(step.divergence for step in value_record.steps)
        summary["vf_cg_steps"] = sum(step.cg_steps for step in value_record.steps)
    if value_record.policy_kl is not None:
        summary["vf_policy_kl"] = value_record.policy_kl
    return summary
