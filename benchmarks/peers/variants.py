"""Our settings with one choice changed: undone, for the ablation, or tried, before they were chosen."""

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


#: sb3-contrib's fit, with the numbers of the zoo
_ADAM = {"vf_optimizer": "adam", "learning_rate": 1e-3, "batch_size": 128, "n_critic_updates": 20}

VARIANTS = {
    SHIPPED: Variant("as shipped", {}),
    "one-value-step": Variant("one value step a batch, not up to five", {"vf_steps": 1}),
    "small-epsilon": Variant("ε = 0.01, not 0.2", {"vf_trust_region": 0.01}),
    "weak-damping": Variant("damping of the value fit 0.01", {"vf_cg_damping": 0.01}),
    "monte-carlo": Variant("Monte-Carlo targets, not λ-returns", {"value_lambda": 1.0}),
    "adam": Variant(
        "the value function fitted by Adam, as sb3-contrib does",
        _ADAM,
    ),
    "raw-observations": Variant("observations not normalised", {"normalize": False}),
    "raw-advantages": Variant("advantages not standardised", {"normalize_advantage": False}),
    "large-batch": Variant("batches of 8 192 steps, not 2 048", {"n_steps": 1024}),
    "low-lambda": Variant("λ = 0.9, not 0.95", {"gae_lambda": 0.9}),
    "high-lambda": Variant("λ = 1, not 0.95", {"gae_lambda": 1.0}),
}

# All that was varied, so that what is shipped later does not change what was tried
_BEFORE_TUNING = {
    "n_envs": 8,
    "n_steps": 256,
    "gae_lambda": 0.95,
    "target_kl": 0.01,
    "policy_kwargs": "dict(log_std_init=-1)",
    "cg_damping": 0.1,
    "vf_steps": 5,
    "vf_trust_region": 0.2,
    "vf_cg_damping": "auto",
}

_STD_SMALLER = {"policy_kwargs": "dict(log_std_init=-2)"}
_MANY_JOINTS = _STD_SMALLER | {"target_kl": 0.03, "gae_lambda": 0.9}
_STD_1 = {"policy_kwargs": "dict(log_std_init=0)"}
_STD_1_TWO_ENVS = _STD_1 | {"n_envs": 2, "n_steps": 1024}

#: settings that were tried on the seeds for tuning
CANDIDATES = {
    f"try-{name}": Variant(title, _BEFORE_TUNING | overrides)
    for name, title, overrides in (
        ("first", "starting point: KL 0.01, five value steps at ε = 0.2, std e⁻¹, 8 × 256 steps", {}),
        ("gymnasium", "… stepped by gymnasium, not by EnvPool", {"batched_envs": False}),
        ("envs-32", "… 32 environments × 64 steps", {"n_envs": 32, "n_steps": 64}),
        ("two-envs", "… 2 environments × 1 024 steps", {"n_envs": 2, "n_steps": 1024}),
        ("small-batch", "… batches of 1 024 steps", {"n_steps": 128}),
        ("kl-.03", "… KL 0.03", {"target_kl": 0.03}),
        ("kl-.03-envs-32", "… KL 0.03, 32 × 64 steps", {"target_kl": 0.03, "n_envs": 32, "n_steps": 64}),
        ("kl-.03-lambda-.9", "… KL 0.03, λ 0.9", {"target_kl": 0.03, "gae_lambda": 0.9}),
        ("kl-.03-lambda-.8", "… KL 0.03, λ 0.8", {"target_kl": 0.03, "gae_lambda": 0.8}),
        ("kl-.03-curvature-512", "… KL 0.03, curvature on 512 steps", {"target_kl": 0.03, "curvature_samples": 512}),
        ("kl-.05", "… KL 0.05", {"target_kl": 0.05}),
        ("std-.14", "initial std e⁻²", _STD_SMALLER),
        ("std-.14-kl-.03", "initial std e⁻², KL 0.03", _STD_SMALLER | {"target_kl": 0.03}),
        ("std-.14-lambda-.9", "initial std e⁻², λ 0.9", _STD_SMALLER | {"gae_lambda": 0.9}),
        ("std-.14-kl-.03-lambda-.9", "initial std e⁻², KL 0.03, λ 0.9", _MANY_JOINTS),
        (
            "std-.14-kl-.03-gamma-.95",
            "initial std e⁻², KL 0.03, γ 0.95, λ 0.9",
            _STD_SMALLER | {"target_kl": 0.03, "gamma": 0.95, "gae_lambda": 0.9},
        ),
        ("std-.14-kl-.06-lambda-.9", "initial std e⁻², KL 0.06, λ 0.9", _MANY_JOINTS | {"target_kl": 0.06}),
        (
            "std-.14-kl-.06-lambda-.9-large-batch",
            "initial std e⁻², KL 0.06, λ 0.9, batches of 4 096 steps",
            _MANY_JOINTS | {"target_kl": 0.06, "n_steps": 512},
        ),
        (
            "std-.14-kl-.1-lambda-.9-large-batch",
            "initial std e⁻², KL 0.1, λ 0.9, batches of 4 096 steps",
            _MANY_JOINTS | {"target_kl": 0.1, "n_steps": 512},
        ),
        (
            "std-.14-kl-.03-lambda-.9-small-batch",
            "initial std e⁻², KL 0.03, λ 0.9, batches of 1 024 steps",
            _MANY_JOINTS | {"n_steps": 128},
        ),
        (
            "std-.14-kl-.03-lambda-.9-wide",
            "initial std e⁻², KL 0.03, λ 0.9, two layers of 256 units",
            _MANY_JOINTS | {"policy_kwargs": "dict(log_std_init=-2, net_arch=[256, 256])"},
        ),
        (
            "std-.14-kl-.03-lambda-.9-adam",
            "initial std e⁻², KL 0.03, λ 0.9, value function fitted by Adam",
            _MANY_JOINTS | _ADAM,
        ),
        ("std-.6", "initial std e^-½", {"policy_kwargs": "dict(log_std_init=-0.5)"}),
        ("std-1", "initial std 1", _STD_1),
        ("std-1-kl-.03", "initial std 1, KL 0.03", _STD_1 | {"target_kl": 0.03}),
        ("std-1-kl-.005", "initial std 1, KL 0.005", _STD_1 | {"target_kl": 0.005}),
        ("std-1-kl-.03-lambda-.9", "initial std 1, KL 0.03, λ 0.9", _STD_1 | {"target_kl": 0.03, "gae_lambda": 0.9}),
        ("std-1-kl-.03-lambda-.98", "initial std 1, KL 0.03, λ 0.98", _STD_1 | {"target_kl": 0.03, "gae_lambda": 0.98}),
        ("std-1-lambda-.9", "initial std 1, λ 0.9", _STD_1 | {"gae_lambda": 0.9}),
        ("std-1-kl-.05", "initial std 1, KL 0.05", _STD_1 | {"target_kl": 0.05}),
        ("std-1-one-value-step", "initial std 1, one value step", _STD_1 | {"vf_steps": 1}),
        ("std-1-epsilon-.02", "initial std 1, five value steps at ε = 0.02", _STD_1 | {"vf_trust_region": 0.02}),
        (
            "std-1-exact-solves",
            "initial std 1, up to 25 steps of conjugate gradient to a tolerance of 0.001",
            _STD_1 | {"cg_tolerance": 0.001, "cg_max_steps": 25, "vf_cg_max_steps": 25},
        ),
        ("std-1-monte-carlo", "initial std 1, Monte-Carlo targets", _STD_1 | {"value_lambda": 1.0}),
        ("std-1-damping-1", "initial std 1, damping of the policy step 1", _STD_1 | {"cg_damping": 1.0}),
        ("std-1-value-damping-1", "initial std 1, damping of the value fit 1", _STD_1 | {"vf_cg_damping": 1.0}),
        ("std-1-adam", "initial std 1, value function fitted by Adam", _STD_1 | _ADAM),
        ("std-1-adam-kl-.05", "initial std 1, value function fitted by Adam, KL 0.05", _STD_1 | _ADAM | {"target_kl": 0.05}),
        ("std-1-envs-32", "initial std 1, 32 environments × 64 steps", _STD_1 | {"n_envs": 32, "n_steps": 64}),
        ("std-1-two-envs", "initial std 1, 2 × 1 024 steps", _STD_1_TWO_ENVS),
        (
            "std-1-two-envs-monte-carlo",
            "initial std 1, 2 × 1 024 steps, Monte-Carlo targets",
            _STD_1_TWO_ENVS | {"value_lambda": 1.0},
        ),
        # All above were run when the damping of the value fit was 0.01 of each step's own error; these are since
        ("one-damping-kl-.01", "one damping: initial std 1, KL 0.01", _STD_1),
        ("one-damping-.01", "one damping, of 0.01: initial std 1, KL 0.01", _STD_1 | {"vf_cg_damping": 0.01}),
        (
            "one-damping-.01-kl-.03",
            "one damping, of 0.01: initial std 1, KL 0.03",
            _STD_1 | {"vf_cg_damping": 0.01, "target_kl": 0.03},
        ),
    )
}

_PENDULUM = {
    "n_envs": 8,
    "n_steps": 128,
    "gamma": 0.9,
    "gae_lambda": 0.95,
    "target_kl": 0.01,
    "use_sde": False,
    "sde_sample_freq": 4,
    "cg_damping": 0.1,
    "vf_cg_damping": "auto",
}
# Two environments as the zoo has for trpo
_SDE = {"use_sde": True, "sde_sample_freq": 4}
_SDE_TWO_ENVS = _SDE | {"n_envs": 2, "n_steps": 1024}
_SDE_1024 = _SDE | {"n_envs": 2, "n_steps": 512}

#: settings that were tried on Pendulum-v1, where a run takes seconds
PENDULUM_CANDIDATES = {
    f"try-pendulum-{name}": Variant(title, _PENDULUM | overrides)
    for name, title, overrides in (
        ("first", "as before tuning: 8 × 128 steps, KL 0.01, λ 0.95", {}),
        ("sde", "gSDE, a new noise matrix every four steps", _SDE),
        ("sde-kl-.03", "gSDE, KL 0.03", _SDE | {"target_kl": 0.03}),
        ("sde-kl-.03-batch-2048", "gSDE, KL 0.03, 8 × 256 steps", _SDE | {"target_kl": 0.03, "n_steps": 256}),
        ("sde-batch-512", "gSDE, 8 × 64 steps", _SDE | {"n_steps": 64}),
        ("sde-two-envs", "gSDE, 2 × 1 024 steps", _SDE_TWO_ENVS),
        ("sde-two-envs-kl-.03", "gSDE, 2 × 1 024 steps, KL 0.03", _SDE_TWO_ENVS | {"target_kl": 0.03}),
        ("sde-two-envs-1024", "gSDE, 2 × 512 steps", _SDE_1024),
        ("sde-two-envs-1024-kl-.005", "gSDE, 2 × 512 steps, KL 0.005", _SDE_1024 | {"target_kl": 0.005}),
        ("sde-two-envs-1024-damping-1", "gSDE, 2 × 512 steps, damping of the policy step 1", _SDE_1024 | {"cg_damping": 1.0}),
        (
            "sde-two-envs-1024-value-damping-.01",
            "gSDE, 2 × 512 steps, damping of the value fit 0.01",
            _SDE_1024 | {"vf_cg_damping": 0.01},
        ),
        (
            "sde-two-envs-1024-value-damping-3",
            "gSDE, 2 × 512 steps, damping of the value fit 3",
            _SDE_1024 | {"vf_cg_damping": 3.0},
        ),
        ("sde-two-envs-1024-lambda-.98", "gSDE, 2 × 512 steps, λ 0.98", _SDE_1024 | {"gae_lambda": 0.98}),
        (
            "sde-two-envs-1024-damping-.01",
            "gSDE, 2 × 512 steps, damping of the policy step 0.01",
            _SDE_1024 | {"cg_damping": 0.01},
        ),
        ("sde-two-envs-1024-gamma-.95", "gSDE, 2 × 512 steps, γ 0.95", _SDE_1024 | {"gamma": 0.95}),
        ("sde-two-envs-1024-gamma-.97", "gSDE, 2 × 512 steps, γ 0.97", _SDE_1024 | {"gamma": 0.97}),
        (
            "sde-two-envs-1024-gamma-.95-noise-8",
            "gSDE, a new noise matrix every eight steps, 2 × 512 steps, γ 0.95",
            _SDE_1024 | {"gamma": 0.95, "sde_sample_freq": 8},
        ),
        ("sde-two-envs-1024-vf-steps-10", "gSDE, 2 × 512 steps, up to ten value steps", _SDE_1024 | {"vf_steps": 10}),
        (
            "sde-two-envs-1024-normalized",
            "gSDE, 2 × 512 steps, normalised observations",
            _SDE_1024 | {"normalize": "dict(norm_obs=True, norm_reward=False)"},
        ),
        (
            "sde-two-envs-1024-noise-8",
            "gSDE, a new noise matrix every eight steps, 2 × 512 steps",
            _SDE_1024 | {"sde_sample_freq": 8},
        ),
        ("sde-lambda-.9", "gSDE, λ 0.9", _SDE | {"gae_lambda": 0.9}),
        ("sde-lambda-.99", "gSDE, λ 0.99", _SDE | {"gae_lambda": 0.99}),
    )
}

# The whole episode in a batch; the rest as for Walker2d when these were tried
_SWIMMER = {
    "n_envs": 2,
    "n_steps": 1024,
    "gamma": 0.9999,
    "target_kl": 0.01,
    "cg_damping": 0.1,
    "gae_lambda": 0.98,
    "vf_cg_damping": "auto",
}

#: settings that were tried on Swimmer-v5, where many agents curl up and creep: chance, which takes many seeds to see through
SWIMMER_CANDIDATES = {
    f"try-swimmer-{name}": Variant(title, _SWIMMER | overrides)
    for name, title, overrides in (
        ("lambda-.95", "λ 0.95, damping of the policy step 0.1", {"gae_lambda": 0.95}),
        ("lambda-.98", "λ 0.98, damping of the policy step 0.1", {}),
        ("damping-1", "λ 0.98, damping of the policy step 1", {"cg_damping": 1.0}),
        ("damping-3", "λ 0.98, damping of the policy step 3", {"cg_damping": 3.0}),
        (
            "damping-3-value-damping-3",
            "λ 0.98, damping of the policy step and of the value fit 3",
            {"cg_damping": 3.0, "vf_cg_damping": 3.0},
        ),
    )
}

# What tasks had beside the damping of the value fit when that was tried
_WHEN_DAMPED: dict[str, dict[str, Any]] = {
    "HalfCheetah-v5": {"target_kl": 0.03, "policy_kwargs": "dict(log_std_init=-1)"},
    "Hopper-v5": _STD_1 | {"target_kl": 0.01},
    "Walker2d-v5": _STD_1 | {"target_kl": 0.03},
    "Ant-v5": _STD_SMALLER | {"target_kl": 0.01, "gae_lambda": 0.9},
}

_AUTO_OR_3: dict[str, tuple[str, dict[str, Any]]] = {
    "auto": ('"auto", 0.29 here', {"vf_cg_damping": "auto"}),
    "damping-3": ("3", {"vf_cg_damping": 3.0}),
}
_DAMPINGS: dict[str, dict[str, tuple[str, dict[str, Any]]]] = {
    "HalfCheetah-v5": _AUTO_OR_3,
    "Hopper-v5": {"damping-.01": ("0.01", {"vf_cg_damping": 0.01})} | _AUTO_OR_3,
    "Walker2d-v5": _AUTO_OR_3,
    "Ant-v5": _AUTO_OR_3
    | {"policy-damping-10": ('"auto", and 10 for the policy step', {"vf_cg_damping": "auto", "cg_damping": 10.0})},
}

#: dampings of the value fit that were tried, by task
DAMPING_CANDIDATES = {
    task: {
        f"try-{task.removesuffix('-v5').lower()}-{name}": Variant(title, _WHEN_DAMPED[task] | {"cg_damping": 0.1} | damping)
        for name, (title, damping) in dampings.items()
    }
    for task, dampings in _DAMPINGS.items()
}

_HUMANOID = _MANY_JOINTS | {"cg_damping": 0.1, "vf_cg_damping": "auto"}
_HUMANOID_DAMPED = {"cg_damping": 30.0, "vf_cg_damping": 3.0}
_STD_LARGER = {"policy_kwargs": "dict(log_std_init=-1)"}

#: settings that were tried on Humanoid-v5, where few agents walk within a million steps
HUMANOID_CANDIDATES = {
    f"try-humanoid-{name}": Variant(title, _HUMANOID | overrides)
    for name, title, overrides in (
        ("kl-.03", "KL 0.03", {}),
        ("value-damping-3", "KL 0.03, damping of the value fit 3", {"vf_cg_damping": 3.0}),
        ("kl-.06-value-damping-3", "KL 0.06, damping of the value fit 3", {"target_kl": 0.06, "vf_cg_damping": 3.0}),
        ("kl-.1-value-damping-3", "KL 0.1, damping of the value fit 3", {"target_kl": 0.1, "vf_cg_damping": 3.0}),
        (
            "both-dampings",
            "KL 0.03, damping of the policy step 10, of the value fit 3",
            {"cg_damping": 10.0, "vf_cg_damping": 3.0},
        ),
        (
            "policy-damping-30",
            "KL 0.03, damping of the policy step 30, of the value fit 3",
            _HUMANOID_DAMPED,
        ),
        (
            "policy-damping-100",
            "KL 0.03, damping of the policy step 100, of the value fit 3",
            {"cg_damping": 100.0, "vf_cg_damping": 3.0},
        ),
        (
            "kl-.06-both-dampings",
            "KL 0.06, damping of the policy step 10, of the value fit 3",
            {"target_kl": 0.06, "cg_damping": 10.0, "vf_cg_damping": 3.0},
        ),
        (
            "kl-.06-policy-damping-30",
            "KL 0.06, damping of the policy step 30, of the value fit 3",
            _HUMANOID_DAMPED | {"target_kl": 0.06},
        ),
        ("lambda-.7", "λ 0.7, KL 0.03, dampings 30 and 3", _HUMANOID_DAMPED | {"gae_lambda": 0.7}),
        (
            "lambda-.7-value-lambda-.9",
            "λ 0.7 and 0.9 of the value targets, KL 0.03, dampings 30 and 3",
            _HUMANOID_DAMPED | {"gae_lambda": 0.7, "value_lambda": 0.9},
        ),
        (
            "value-lambda-.97",
            "λ 0.9 and 0.97 of the value targets, KL 0.03, dampings 30 and 3",
            _HUMANOID_DAMPED | {"value_lambda": 0.97},
        ),
        (
            "batch-1024",
            "batches of 1 024 steps, KL 0.03, dampings 30 and 3",
            _HUMANOID_DAMPED | {"n_steps": 128},
        ),
        (
            "batch-1024-kl-.015",
            "batches of 1 024 steps, KL 0.015, dampings 30 and 3",
            _HUMANOID_DAMPED | {"n_steps": 128, "target_kl": 0.015},
        ),
        ("std-.37", "initial std e⁻¹, KL 0.03, dampings 30 and 3", _HUMANOID_DAMPED | _STD_LARGER),
        (
            "std-.37-policy-damping-5",
            "initial std e⁻¹, KL 0.03, dampings 5 and 3",
            _HUMANOID_DAMPED | _STD_LARGER | {"cg_damping": 5.0},
        ),
        ("lambda-.95", "λ 0.95, KL 0.03, dampings 30 and 3", _HUMANOID_DAMPED | {"gae_lambda": 0.95}),
        ("lambda-.98", "λ 0.98, KL 0.03, dampings 30 and 3", _HUMANOID_DAMPED | {"gae_lambda": 0.98}),
    )
}

#: all of them, by name
EVERY_VARIANT = {
    name: variant
    for variants in (
        VARIANTS,
        CANDIDATES,
        PENDULUM_CANDIDATES,
        SWIMMER_CANDIDATES,
        HUMANOID_CANDIDATES,
        *DAMPING_CANDIDATES.values(),
    )
    for name, variant in variants.items()
}
