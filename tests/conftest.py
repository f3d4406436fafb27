"""Settings of all tests, and fixtures that several files need."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
import torch as th
from hypothesis import settings
from pendulum_task import PENDULUM
from resuming import train
from saved_models import saved, trained_model
from sweep_table import CELLS, fill

from sb3_gae import TRPOGAE
from sb3_gae.sweep import SweepStudy, results_of

# Small networks: more threads would only fight over the cores
th.set_num_threads(1)

# No deadline and no database: slow machines and read-only checkouts run the same tests
settings.register_profile("sb3_gae", deadline=None, database=None, print_blob=True, max_examples=40)
settings.load_profile("sb3_gae")


@pytest.fixture(autouse=True, scope="session")
def sb3_logs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """SB3 makes a folder for every training that is given none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("sb3")))
        yield


@pytest.fixture(autouse=True, scope="session")
def interruptible() -> Iterator[None]:
    """A shell has its background jobs ignore Ctrl-C, and tests may be one."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def pendulum(tmp_path: Path) -> Path:
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    return path


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the last three checkpoints of a training of four iterations; tests copy what they change."""
    folder = tmp_path_factory.mktemp("trained")
    train(folder, 4)
    return folder


@pytest.fixture(scope="module")
def some_model() -> TRPOGAE:
    """Trained; tests leave it as it is."""
    return trained_model()


@pytest.fixture(scope="module")
def model_file(some_model: TRPOGAE) -> bytes:
    return saved(some_model)


@pytest.fixture(scope="session")
def sweep_table(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    """Results of seven curves, five seeds and four iterations; tests leave them as they are."""
    study = SweepStudy("s", str(tmp_path_factory.mktemp("sweep") / "s.journal"))
    fill(study, CELLS)
    return results_of(study)
