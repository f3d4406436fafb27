"""Settings of all tests."""

import signal
from collections.abc import Iterator

import pytest
import torch as th
from hypothesis import settings

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
