"""What an installation must hold, and a hyperparameter file that fits the algorithm."""

import configparser
import inspect
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
import yaml

import sb3_gae
import sb3_gae.envs
from sb3_gae import TRPOGAE, zoo

HYPERPARAMS: dict[str, dict[str, Any]] = yaml.safe_load(zoo.default_hyperparams_path().read_text())

# rl-zoo3 takes these out before it hands the rest to the algorithm
ZOO_KEYS = {
    *("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps", "normalize"),
    *("vec_env_wrapper", "batched_envs", "eval_freq"),
}

TASKS = [
    *sb3_gae.envs.TASKS,
    *("CartPole-v1", "Acrobot-v1", "Pendulum-v1", "MountainCarContinuous-v0"),
    *("LunarLander-v3", "LunarLanderContinuous-v3", "BipedalWalker-v3"),
    *("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Swimmer-v5", "Humanoid-v5", "HumanoidStandup-v5"),
    *("Reacher-v5", "Pusher-v5", "InvertedPendulum-v5", "InvertedDoublePendulum-v5"),
]


def test_every_task_has_settings() -> None:
    assert set(TASKS) | {"default"} <= HYPERPARAMS.keys()


@pytest.mark.parametrize("task", HYPERPARAMS)
def test_settings_are_known_to_the_algorithm_or_the_zoo(task: str) -> None:
    settings = HYPERPARAMS[task].keys()
    assert {"policy", "n_timesteps"} <= settings
    assert settings - ZOO_KEYS <= inspect.signature(TRPOGAE).parameters.keys()


def test_settings_are_found_in_a_package_and_in_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "sb3_gae"
    package.mkdir()
    monkeypatch.setattr(zoo.registration, "__file__", str(package / "zoo" / "registration.py"))
    assert zoo.default_hyperparams_path() == tmp_path / "hyperparams" / "trpo_gae.yml"

    installed = package / "hyperparams" / "trpo_gae.yml"
    installed.parent.mkdir()
    installed.touch()
    assert zoo.default_hyperparams_path() == installed


def test_there_is_one_copy_of_the_settings() -> None:
    package = Path(sb3_gae.__file__).parent
    copies = [package / "hyperparams" / "trpo_gae.yml", package.parent / "hyperparams" / "trpo_gae.yml"]
    assert [copy.is_file() for copy in copies].count(True) == 1


@pytest.mark.parametrize("suffix", [".pth", ".start"])
def test_uninstalling_takes_the_startup_files_away(suffix: str) -> None:
    """They are recorded as files of the distribution, directly in site-packages, and are there."""
    files = {str(file): file.locate() for file in distribution("sb3-gae").files or []}
    assert Path(files[f"sb3_gae_zoo_hook{suffix}"]).is_file()


def test_version_comes_from_one_place() -> None:
    assert sb3_gae.__version__ == distribution("sb3-gae").version, "the package has to be installed again"


def test_types_are_for_users_too() -> None:
    assert (Path(sb3_gae.__file__).parent / "py.typed").is_file()


def test_files_that_are_no_code_are_installed_too() -> None:
    package = Path(sb3_gae.__file__).parent
    setup_cfg = package.parent / "setup.cfg"
    if not setup_cfg.is_file():
        pytest.skip("not a checkout")
    settings = configparser.ConfigParser()
    settings.read(setup_cfg)
    patterns = settings["options.package_data"]["sb3_gae"].split()
    installed = {file for pattern in patterns for file in package.glob(pattern)}
    files = {file for file in package.rglob("*") if file.is_file() and file.suffix not in (".py", ".pyc")}
    assert len([file for file in files if file.suffix == ".xml"]) >= 3
    assert files <= installed


def test_extras_exist() -> None:
    assert {"tests", "docs", "fast", "lab", "postgresql", "ray", "sweep"} <= set(
        distribution("sb3-gae").metadata.get_all("Provides-Extra") or []
    )
