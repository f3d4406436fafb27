"""Arguments of :class:`~sb3_gae.TRPOGAE`: their domains, and those that belong to other algorithms."""

import warnings
from collections.abc import Mapping
from typing import Any

from sb3_gae.checks import check_choice, check_count, check_number
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer

_STEP_SIZE = "the sizes of the steps are set by `target_kl` and `vf_trust_region`"
_ADAM = "or pass `vf_optimizer='adam'` to fit the value function as sb3-contrib's TRPO does"

#: arguments of sb3-contrib's TRPO that only its value fit reads, and what to use instead
ADAM_ARGUMENTS: dict[str, str] = {
    "learning_rate": f"{_STEP_SIZE}, {_ADAM}",
    "batch_size": f"each step uses the whole rollout; set `n_steps`, {_ADAM}",
    "n_critic_updates": f"set `vf_steps`, {_ADAM}",
}

#: arguments of SB3's PPO and A2C, and what to use instead
FOREIGN_ARGUMENTS: dict[str, str] = {
    "ent_coef": "there is no entropy bonus; a larger `policy_kwargs['log_std_init']` explores more",
    "vf_coef": "policy and value function have steps of their own; set `vf_trust_region`",
    "max_grad_norm": _STEP_SIZE,
    "n_epochs": "the policy takes one step a rollout; set `vf_steps` for the value function",
    "clip_range": "set `target_kl`",
    "clip_range_vf": "set `vf_trust_region`",
    "use_rms_prop": _STEP_SIZE,
    "rms_prop_eps": _STEP_SIZE,
}

_LEAST_COUNTS = {
    **dict.fromkeys(("n_steps", "cg_max_steps", "vf_cg_max_steps", "line_search_max_iter"), 1),
    **dict.fromkeys(("sub_sampling_factor", "batch_size"), 1),
    **dict.fromkeys(("vf_steps", "n_critic_updates"), 0),
}
_CHOICES: dict[str, tuple[Any, ...]] = {
    "vf_optimizer": ("trust_region", "adam"),
    "baseline": ("value", "time"),
    **dict.fromkeys(("value_fit_first", "normalize_advantage", "normalize_value"), (False, True)),
}


def warn_of_unused(adam_arguments: Mapping[str, Any], vf_optimizer: str, foreign_arguments: Mapping[str, Any]) -> None:
    """
    Say of each argument without effect what to use instead.

    :param adam_arguments: values of those in :data:`ADAM_ARGUMENTS`, None where the user gave none
    :param vf_optimizer: whether Adam is used
    :param foreign_arguments: what the user passed beyond the signature
    :raises TypeError: if an argument is not even another algorithm's
    """
    for name in foreign_arguments:
        if name not in FOREIGN_ARGUMENTS:
            raise TypeError(f"TRPOGAE.__init__() got an unexpected keyword argument {name!r}")
        _warn(name, FOREIGN_ARGUMENTS[name])
    for name, value in adam_arguments.items():
        if value is not None and vf_optimizer == "trust_region":
            _warn(name, ADAM_ARGUMENTS[name])


def _warn(name: str, advice: str) -> None:
    # Point to the line that constructs the algorithm
    warnings.warn(f"`{name}` has no effect here: {advice}.", UserWarning, stacklevel=4)


def check_hyperparameters(values: Mapping[str, Any]) -> None:
    """
    :param values: attributes of the algorithm by name, before its networks are built
    :raises ValueError: if one is outside its domain
    :raises TypeError: if the rollout buffer cannot keep what the algorithm needs
    """
    for name in ("gamma", "gae_lambda"):
        check_number(name, values[name], 0.0, 1.0)
    if values["value_lambda"] is not None:
        check_number("value_lambda", values["value_lambda"], 0.0, 1.0)
    for name in ("target_kl", "vf_trust_region"):
        check_number(name, values[name], 0.0, above=True, below=True)
    check_number("cg_damping", values["cg_damping"], 0.0, below=True)
    _check_vf_cg_damping(values["vf_cg_damping"])
    for name in ("cg_tolerance", "vf_kl_fraction"):
        check_number(name, values[name], 0.0, 1.0, below=True)
    check_number("line_search_shrinking_factor", values["line_search_shrinking_factor"], 0.0, 1.0, above=True, below=True)
    for name, low in _LEAST_COUNTS.items():
        check_count(name, values[name], low)
    if values["n_episodes"] is not None:
        check_count("n_episodes", values["n_episodes"])
    if values["curvature_samples"] is not None:
        check_count("curvature_samples", values["curvature_samples"], low=2)
    for name, choices in _CHOICES.items():
        check_choice(name, values[name], choices)
    if values["baseline"] == "time" and (values["value_fit_first"] or values["_lambda_rule"] is not None):
        raise ValueError(
            "`baseline` = 'time' has neither a value function to fit first nor a lambda to choose; leave out "
            "`value_fit_first`, and give `gae_lambda` a number or nothing."
        )
    _check_vf_kl_fraction(values)
    _check_buffer_class(values["rollout_buffer_class"])
    for name in ("gamma", "gae_lambda", "value_lambda"):
        if name in values["rollout_buffer_kwargs"]:
            raise ValueError(f"Pass `{name}` to TRPOGAE itself and not in `rollout_buffer_kwargs`.")


def _check_vf_cg_damping(damping: Any) -> None:
    if not isinstance(damping, str):
        check_number("vf_cg_damping", damping, 0.0, below=True)
    elif damping != "auto":
        raise ValueError(f"`vf_cg_damping` must be a number in [0, inf) or 'auto', got {damping!r}.")


def _check_vf_kl_fraction(values: Mapping[str, Any]) -> None:
    if values["vf_kl_fraction"] == 0.0:
        return
    for name, value in (("vf_optimizer", "trust_region"), ("baseline", "value"), ("value_fit_first", False)):
        if values[name] != value:
            raise ValueError(
                f"`vf_kl_fraction` = {values['vf_kl_fraction']!r} is for a value fit by trust region after the policy step; "
                f"set it to 0, or leave out `{name}` = {values[name]!r}."
            )


def check_batch(n_steps: int, n_envs: int, sub_sampling_factor: int, n_episodes: int | None) -> None:
    """
    :param n_steps: of each environment
    :param n_envs: number of environments
    :param sub_sampling_factor: one of so many samples is in the batch of the policy
    :param n_episodes: of each environment; None for batches of ``n_steps`` steps
    :raises ValueError: if there is too little in a batch to learn from
    """
    if n_episodes is not None and n_episodes * n_envs < 2:
        raise ValueError("A batch needs at least 2 episodes, but `n_episodes` = 1 in one environment gives 1; raise it.")
    n_samples = n_steps * n_envs // sub_sampling_factor
    if n_samples < 2:
        raise ValueError(
            f"A batch needs at least 2 samples, but `n_steps` = {n_steps} in {n_envs} environment(s) with "
            f"`sub_sampling_factor` = {sub_sampling_factor} gives {n_samples}; raise `n_steps` or "
            "lower `sub_sampling_factor`."
        )


def _check_buffer_class(buffer_class: Any) -> None:
    if buffer_class is None:
        return
    if not (isinstance(buffer_class, type) and issubclass(buffer_class, GAERolloutBuffer)):
        raise TypeError(
            f"`rollout_buffer_class` must be a subclass of sb3_gae.GAERolloutBuffer, got "
            f"{getattr(buffer_class, '__name__', repr(buffer_class))}: "
            "SB3's own buffers do not keep terminations and truncations apart."
        )
