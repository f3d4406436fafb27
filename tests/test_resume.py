"""A training that stopped goes on as if it had not."""

from pathlib import Path

import pytest
from resuming import STEPS, TRAININGS, differences, everything, make_model

from sb3_gae import TRPOGAE, ResumableCheckpointCallback

pytestmark = pytest.mark.filterwarnings("ignore:`(learning_rate|n_steps|batch_size)`")


@pytest.mark.parametrize("name", TRAININGS)
def test_a_training_goes_on_bit_for_bit(name: str, tmp_path: Path) -> None:
    """From each of its checkpoints."""
    make_env, settings = TRAININGS[name]
    model = make_model(make_env(), **settings)
    model.learn(4 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path / "whole", keep=10))
    expected = everything(model)
    paths = sorted((tmp_path / "whole").iterdir())
    assert len(paths) >= 5
    for number, path in enumerate(paths):
        resumed = TRPOGAE.resume(path, make_env())
        folder = tmp_path / str(number)
        callback = ResumableCheckpointCallback(1, folder)
        resumed.learn(resumed.remaining_timesteps, callback=callback, reset_num_timesteps=False)
        assert differences(expected, everything(resumed)) == [], path.name
