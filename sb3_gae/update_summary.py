"""What an update did, as numbers for the log."""

import numpy as np

from sb3_gae.diagnostics import explained_variance
from sb3_gae.rollout_buffer import GAERolloutBuffer
from sb3_gae.trust_region import StepRecord
from sb3_gae.value_step import ValueFitRecord


def update_summary(
    policy_record: StepRecord, value_record: ValueFitRecord, rollout_buffer: GAERolloutBuffer
) -> dict[str, float]:
    """
    :param policy_record: of the policy step
    :param value_record: of the value fit
    :param rollout_buffer: what the update used
    :return: sb3-contrib's names where it has one; the ``vf_`` entries only after trust-region steps
    """
    # Double precision: squares of values around 1e30 leave the range of single
    mask = rollout_buffer.mask
    collected, returns = (array[mask].astype(np.float64) for array in (rollout_buffer.values, rollout_buffer.returns))
    after = value_record.values_after.cpu().double().numpy()
    summary = {
        "policy_objective": policy_record.objective_after,
        "kl_divergence_loss": policy_record.divergence,
        "is_line_search_success": float(policy_record.accepted),
        "line_search_trials": policy_record.trials,
        "cg_steps": policy_record.cg_steps,
        "value_loss": float(np.mean(np.square(after - returns))),
        "explained_variance": explained_variance(collected, returns),
        "explained_variance_after": explained_variance(after, returns),
    }
    if value_record.steps:
        summary["vf_steps"] = sum(step.accepted for step in value_record.steps)
        summary["vf_kl_divergence"] = max(step.divergence for step in value_record.steps)
        summary["vf_cg_steps"] = sum(step.cg_steps for step in value_record.steps)
    return summary
