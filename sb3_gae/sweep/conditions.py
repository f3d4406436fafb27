"""What is compared beside γ and λ: names of conditions and the arguments of :class:`~sb3_gae.TRPOGAE` they stand for."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_gae.sweep.errors import SweepError


@dataclass(frozen=True)
class Condition:
    """
    :param title: for legends
    :param settings: arguments of TRPOGAE
    :param uses_lambda: whether λ is given to it
    """

    title: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    uses_lambda: bool = True


#: λ = 1 and λ = 0 are values of λ, and so no conditions of their own
CONDITIONS: dict[str, Condition] = {
    "trust_region": Condition("value function by trust region"),
    "no_vf": Condition("no value function", {"baseline": "time"}, uses_lambda=False),
    "improvement_lambda": Condition("λ by the measured improvement", {"gae_lambda": "improvement"}, uses_lambda=False),
    "auto_lambda": Condition("λ by the measured squared error", {"gae_lambda": "auto"}, uses_lambda=False),
    "explained_variance_lambda": Condition(
        "λ by the explained variance", {"gae_lambda": "explained_variance"}, uses_lambda=False
    ),
    "value_first": Condition("value function before policy", {"value_fit_first": True}),
    "adam": Condition("value function by Adam", {"vf_optimizer": "adam"}),
    "mc_targets": Condition("Monte-Carlo targets", {"value_lambda": 1.0}),
    "lambda_targets": Condition("λ targets", {"value_lambda": None}),
    "shared_frozen": Condition("shared layers, frozen in the value fit", {"policy": "SharedMlpPolicy", "vf_kl_fraction": 0.0}),
    "shared_joint": Condition("shared layers, fitted jointly", {"policy": "SharedMlpPolicy", "vf_kl_fraction": 0.01}),
}


def find_condition(name: str) -> Condition:
    """
    :param name: a key of :data:`CONDITIONS`
    :return: the condition
    :raises SweepError: if there is none of that name
    """
    if name not in CONDITIONS:
        raise SweepError(f"`conditions` knows {', '.join(CONDITIONS)}, got {name!r}{did_you_mean(name, CONDITIONS)}")
    return CONDITIONS[name]


def did_you_mean(name: str, known: Any) -> str:
    """
    :param name: what was typed
    :param known: names that would have been right
    :return: the end of a sentence
    """
    near = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else "."
