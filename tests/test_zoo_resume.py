"""rl-zoo3 writes checkpoints and goes on from them."""

import signal
from pathlib import Path
from typing import Any

import pytest
from resuming import differences, everything
from stable_baselines3.common.callbacks import BaseCallback
from test_zoo_keys import manager, registered  # noqa: F401 - a fixture

from sb3_gae.saving.checkpoint_file import checkpoints_in

ITERATION = 32  # timesteps, by the settings of test_zoo_keys
NORMALIZED = {"normalize": True, "n_timesteps": 4 * ITERATION, "batched_envs": True}


class RaiseSignal(BaseCallback):
    """
    :param number: of the signal
    :param at: timesteps
    """

    def __init__(self, number: int, at: int):
        super().__init__()
        self.number, self.at = number, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            signal.raise_signal(self.number)
        return True


def train(folder: Path, trained_agent: str = "", signal_at: tuple[int, int] | None = None) -> Any:
    folder.mkdir(exist_ok=True)
    callbacks: list[Any] = [
        {"sb3_gae.ResumableCheckpointCallback": {"save_freq": 1, "save_path": str(folder / "checkpoints")}}
    ]
    if signal_at is not None:
        callbacks.append({"test_zoo_resume.RaiseSignal": dict(zip(("number", "at"), map(int, signal_at), strict=True))})
    experiment = manager(folder, callback=callbacks, **NORMALIZED)
    experiment.n_timesteps = 0
    experiment.trained_agent, experiment.continue_training = trained_agent, bool(trained_agent)
    made = experiment.setup_experiment()
    assert made is not None
    experiment.learn(made[0])
    experiment.save_trained_model(made[0])
    return made[0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_training_that_a_signal_ended_goes_on_bit_for_bit(number: int, tmp_path: Path) -> None:
    expected = everything(train(tmp_path / "whole"))
    stopped = tmp_path / "stopped"
    if number == signal.SIGINT:
        # rl-zoo3 takes it as the wish to save what there is
        assert train(stopped, signal_at=(number, 2 * ITERATION - 2)).num_timesteps == 2 * ITERATION
    else:
        with pytest.raises(SystemExit):
            train(stopped, signal_at=(number, 2 * ITERATION - 2))
    newest = checkpoints_in(stopped / "checkpoints")[0]
    assert newest.name == f"rl_model_{2 * ITERATION}_steps.zip"
    resumed = train(stopped, str(newest))
    assert resumed.num_timesteps == 4 * ITERATION
    assert differences(expected, everything(resumed)) == []


def test_a_model_that_is_no_checkpoint_is_taken_for_its_weights_as_ever(tmp_path: Path) -> None:
    train(tmp_path)
    (saved,) = (tmp_path / "logs").rglob("GaeCartPole-v0.zip")
    for path in checkpoints_in(tmp_path / "checkpoints"):
        path.unlink()
    model = train(tmp_path, str(saved))
    assert model.num_timesteps == 4 * ITERATION and model._n_updates == 8
