"""
Registration with rl-zoo3: the algorithm, its default hyperparameter file, and the Optuna sampler and converter.

The start-up hook (``sb3_gae_zoo_hook.py``) calls ``integrate`` for each module of rl-zoo3 that matters when it has just
been imported; without the hook, ``register`` does the same for all of them. Both can be repeated. This module imports
nothing of rl-zoo3 at its top: it is itself imported while rl-zoo3 is being imported.
"""

import functools
import importlib
import inspect
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from torch import nn

from sb3_gae.trpo_gae import TRPOGAE
from sb3_gae.zoo.hub_repairs import repair_hub_verbs
from sb3_gae.zoo.keys import METHODS_WITH_KEYS, add_keys
from sb3_gae.zoo.resuming import METHODS_THAT_RESUME, add_resuming

if TYPE_CHECKING:
    import optuna

ALGO = "trpo_gae"
SUPPORTED_ZOO = ">=2.9,<3"

# rl-zoo3 lower-cases the class name on a model card to get the algorithm, which gives "trpogae" for ours
CARD_NAMES = {TRPOGAE.__name__.lower(): ALGO}

NET_ARCHS: dict[str, list[int]] = {
    "tiny": [64],
    "small": [64, 64],
    "medium": [256, 256],
    # The paper's network for its 3D tasks
    "paper": [100, 50, 25],
}
ACTIVATION_FNS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
# None stands for "as gae_lambda"; 1 gives the paper's Monte Carlo targets
VALUE_LAMBDAS: dict[str, float | None] = {"gae_lambda": None, "monte_carlo": 1.0}

T = TypeVar("T")


class UnsupportedZooError(RuntimeError):
    """
    The installed rl-zoo3 is not built as we expect, and guessing would fail later and in the dark.

    :param what: the name that we do not understand, in full
    """

    def __init__(self, what: str) -> None:
        version = getattr(sys.modules.get("rl_zoo3"), "__version__", "(version unknown)")
        super().__init__(
            f"rl_zoo3 {version} has a layout that sb3-gae does not know: {what} is missing or not what it was. "
            f'Install one that it knows: pip install "rl_zoo3{SUPPORTED_ZOO}"'
        )


def default_hyperparams_path() -> Path:
    """
    Find the settings that are used when the command line names no ``--conf-file``.

    :return: the file in an installed package or, in an editable install, in the checkout
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "hyperparams" / f"{ALGO}.yml"
    return installed if installed.is_file() else package.parent / "hyperparams" / f"{ALGO}.yml"


def register() -> None:
    """
    Add the algorithm to rl-zoo3 by hand, where the start-up hook is off or cannot run.

    :raises UnsupportedZooError: if rl-zoo3 is not built as we expect
    """
    for name in INTEGRATIONS:
        integrate(importlib.import_module(name))


def integrate(module: ModuleType) -> None:
    """
    Add what belongs into one module of rl-zoo3.

    :param module: one of those named in ``INTEGRATIONS``
    :raises UnsupportedZooError: if it is not built as we expect
    """
    INTEGRATIONS[module.__name__](module)


def _add_algorithm(utils: ModuleType) -> None:
    _expect(utils, "ALGOS", dict)[ALGO] = TRPOGAE
    _translate_card_names(utils)
    if "huggingface_sb3" in sys.modules:
        repair_hub_verbs(sys.modules["huggingface_sb3"])


def _translate_card_names(utils: ModuleType) -> None:
    """Map the names on model cards to ours, as rl-zoo3 itself maps ``recurrentppo`` to ``ppo_lstm``."""
    model_name = _expect(utils, "ModelName", Callable)
    get_models = _expect(utils, "get_hf_trained_models", Callable)
    if _is_ours(get_models):
        return

    # The file that a model is looked for in comes from its name, so a translation of the answer would be too late
    @functools.wraps(model_name, updated=())
    def translated_model_name(algo_name: str, *args: Any, **kwargs: Any) -> Any:
        return model_name(CARD_NAMES.get(algo_name, algo_name), *args, **kwargs)

    @functools.wraps(get_models)
    def translated_models(*args: Any, **kwargs: Any) -> dict[str, tuple[str, str]]:
        return {name: (CARD_NAMES.get(algo, algo), env_id) for name, (algo, env_id) in get_models(*args, **kwargs).items()}

    utils.ModelName = translated_model_name  # type: ignore[attr-defined]
    utils.get_hf_trained_models = _mark_as_ours(translated_models)  # type: ignore[attr-defined]


def _add_sampler(hyperparams_opt: ModuleType) -> None:
    _expect(hyperparams_opt, "HYPERPARAMS_SAMPLER", dict)[ALGO] = sample_trpo_gae_params
    _expect(hyperparams_opt, "HYPERPARAMS_CONVERTER", dict)[ALGO] = convert_trpo_gae_params


def _add_default_hyperparams(exp_manager: ModuleType) -> None:
    """Let ``ExperimentManager`` take our file where it would take ``<rl_zoo3>/hyperparams/trpo_gae.yml``."""
    manager = _expect(exp_manager, "ExperimentManager", type)
    original = manager.__init__
    if _is_ours(original):
        return
    signature = inspect.signature(original)
    if not {"algo", "config"} <= signature.parameters.keys():
        raise UnsupportedZooError(f"{exp_manager.__name__}.{manager.__name__}(algo, config)")
    for name in (*METHODS_WITH_KEYS, *METHODS_THAT_RESUME):
        if not callable(getattr(manager, name, None)):
            raise UnsupportedZooError(f"{exp_manager.__name__}.{manager.__name__}.{name}")

    @functools.wraps(original)
    def init_with_our_default(*args: Any, **kwargs: Any) -> None:
        bound = signature.bind(*args, **kwargs)
        if bound.arguments["algo"] == ALGO and not bound.arguments.get("config"):
            bound.arguments["config"] = str(default_hyperparams_path())
        original(*bound.args, **bound.kwargs)

    manager.__init__ = _mark_as_ours(init_with_our_default)
    add_keys(manager, ALGO)
    add_resuming(manager, TRPOGAE, ALGO)


INTEGRATIONS: dict[str, Callable[[ModuleType], None]] = {
    "rl_zoo3.utils": _add_algorithm,
    "rl_zoo3.hyperparams_opt": _add_sampler,
    "rl_zoo3.exp_manager": _add_default_hyperparams,
}


def _expect(module: ModuleType | type, name: str, kind: Any) -> Any:
    """
    Get an attribute of rl-zoo3 or say that it is not as we know it.

    :param module: where it is
    :param name: its name
    :param kind: what it should be an instance of
    :return: its value
    :raises UnsupportedZooError: if it is missing or something else
    """
    value = getattr(module, name, None)
    if not isinstance(value, kind):
        raise UnsupportedZooError(f"{module.__name__}.{name}")
    return value


def _mark_as_ours(function: T) -> T:
    function.added_by_sb3_gae = True  # type: ignore[attr-defined]
    return function


def _is_ours(function: object) -> bool:
    return getattr(function, "added_by_sb3_gae", False)


def sample_trpo_gae_params(
    trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Sampler for TRPOGAE hyperparams.

    :param trial: the trial to sample for
    :param n_actions: number of continuous actions, 0 where actions are discrete
    :param n_envs: number of environments; batches are about 512 to 8192 transitions whatever it is
    :param additional_args: what off-policy algorithms need, unused
    :return: keyword arguments of TRPOGAE
    """
    log2_n_envs = round(math.log2(n_envs))
    n_steps_pow = trial.suggest_int("n_steps_pow", max(9 - log2_n_envs, 1), max(13 - log2_n_envs, 1))
    # The paper: gamma from 0.96 to 0.999 and lambda from 0.9 to 0.99 do best on its tasks
    one_minus_gamma = trial.suggest_float("one_minus_gamma", 0.0001, 0.05, log=True)
    one_minus_gae_lambda = trial.suggest_float("one_minus_gae_lambda", 0.001, 0.3, log=True)
    value_lambda = trial.suggest_categorical("value_lambda", list(VALUE_LAMBDAS))

    target_kl = trial.suggest_float("target_kl", 0.003, 0.1, log=True)
    cg_max_steps = trial.suggest_int("cg_max_steps", 5, 20)
    vf_trust_region = trial.suggest_float("vf_trust_region", 0.01, 1.0, log=True)
    vf_steps = trial.suggest_int("vf_steps", 1, 10)

    net_arch = trial.suggest_categorical("net_arch", list(NET_ARCHS))
    activation_fn = trial.suggest_categorical("activation_fn", list(ACTIVATION_FNS))

    sampled_params = {
        "n_steps_pow": n_steps_pow,
        "one_minus_gamma": one_minus_gamma,
        "one_minus_gae_lambda": one_minus_gae_lambda,
        "value_lambda": value_lambda,
        "target_kl": target_kl,
        "cg_max_steps": cg_max_steps,
        "vf_trust_region": vf_trust_region,
        "vf_steps": vf_steps,
        "net_arch": net_arch,
        "activation_fn": activation_fn,
    }
    if n_actions > 0:
        sampled_params["log_std_init"] = trial.suggest_float("log_std_init", -2.0, 0.5)

    # Display true values
    trial.set_user_attr("gamma", 1 - one_minus_gamma)
    trial.set_user_attr("gae_lambda", 1 - one_minus_gae_lambda)
    trial.set_user_attr("n_steps", 2**n_steps_pow)

    return convert_trpo_gae_params(sampled_params)


def convert_trpo_gae_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Turn sampled values, fresh or read back from a study (``--trial-id``), into keyword arguments of TRPOGAE.

    :param sampled_params: the parameters of a trial; they are left as they are
    :return: keyword arguments of TRPOGAE
    """
    hyperparams = sampled_params.copy()
    net_arch = NET_ARCHS[hyperparams.pop("net_arch")]
    policy_kwargs: dict[str, Any] = {
        "net_arch": dict(pi=list(net_arch), vf=list(net_arch)),
        "activation_fn": ACTIVATION_FNS[hyperparams.pop("activation_fn")],
    }
    if "log_std_init" in hyperparams:
        policy_kwargs["log_std_init"] = hyperparams.pop("log_std_init")

    return {
        "n_steps": 2 ** hyperparams.pop("n_steps_pow"),
        # Where the settings of a task have whole episodes in a batch, the steps would be the most that one may take
        "n_episodes": None,
        "gamma": 1 - hyperparams.pop("one_minus_gamma"),
        "gae_lambda": 1 - hyperparams.pop("one_minus_gae_lambda"),
        "value_lambda": VALUE_LAMBDAS[hyperparams.pop("value_lambda")],
        "policy_kwargs": policy_kwargs,
        **hyperparams,
    }
