"""Our settings with one choice undone, for the ablation."""

from typing import Any, NamedTuple

#: the shipped settings
SHIPPED = ""


class Variant(NamedTuple):
    """
    :param title: for people
    :param overrides: of the settings, as rl-zoo3 takes them
    """

    title: str
    overrides: dict[str, Any]


VARIANTS = {
    SHIPPED: Variant("as shipped", {}),
    "one-value-step": Variant("one value step a batch, not up to five", {"vf_steps": 1}),
    "small-epsilon": Variant("ε = 0.01, not 0.2", {"vf_trust_region": 0.01}),
    "monte-carlo": Variant("Monte-Carlo targets, not λ-returns", {"value_lambda": 1.0}),
    "adam": Variant(
        "the value function fitted by Adam, as sb3-contrib does",
        {"vf_optimizer": "adam", "learning_rate": 1e-3, "batch_size": 128, "n_critic_updates": 20},
    ),
    "raw-observations": Variant("observations not normalised", {"normalize": False}),
    "raw-advantages": Variant("advantages not standardised", {"normalize_advantage": False}),
    "large-batch": Variant("batches of 8 192 steps, not 2 048", {"n_steps": 1024}),
    "low-lambda": Variant("λ = 0.9, not 0.95", {"gae_lambda": 0.9}),
    "high-lambda": Variant("λ = 1, not 0.95", {"gae_lambda": 1.0}),
}
