"""TRPOGAE in rl-zoo3: registration, a sampler for Optuna, keys of our own."""

from sb3_gae.zoo.registration import (
    ALGO,
    NET_ARCHS,
    UnsupportedZooError,
    convert_trpo_gae_params,
    default_hyperparams_path,
    integrate,
    register,
    sample_trpo_gae_params,
)

__all__ = [
    "ALGO",
    "NET_ARCHS",
    "UnsupportedZooError",
    "convert_trpo_gae_params",
    "default_hyperparams_path",
    "integrate",
    "register",
    "sample_trpo_gae_params",
]
