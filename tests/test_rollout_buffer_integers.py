"""What the rollout buffer keeps of spaces of integers, and of floats that come for them."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_gae import GAEDictRolloutBuffer, GAERolloutBuffer

WHOLE = spaces.Box(0, 255, (2,), np.uint8)
FRACTIONS = np.float32([[-1.5, 0.46], [1.26, 1.53]])


def add_whole_and_fractional_step(buffer: GAERolloutBuffer, key: str | None = None) -> None:
    no = np.zeros(2, dtype=bool)
    for observations in (FRACTIONS.astype(np.uint8), FRACTIONS):
        buffer.add_step(observations if key is None else {key: observations}, FRACTIONS, np.zeros(2), no, no, no)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_floats_that_come_for_a_space_of_integers_are_kept(dtype: type) -> None:
    """Such are the vectors that VecNormalize makes of integers, and the actions that a Gaussian policy draws for them."""
    space = spaces.Box(0, 255, (2,), dtype)
    buffer = GAERolloutBuffer(2, space, space, n_envs=2, device="cpu")
    for _ in range(2):
        add_whole_and_fractional_step(buffer)
        np.testing.assert_array_equal(buffer.observations, [FRACTIONS.astype(np.uint8), FRACTIONS])
        np.testing.assert_array_equal(buffer.actions, [FRACTIONS, FRACTIONS])
        assert buffer.observations.dtype == buffer.actions.dtype == np.float32
        buffer.reset()


def test_floats_that_come_for_integers_in_a_dict_are_kept() -> None:
    buffer = GAEDictRolloutBuffer(2, spaces.Dict({"ram": WHOLE}), WHOLE, n_envs=2, device="cpu")
    add_whole_and_fractional_step(buffer, "ram")
    np.testing.assert_array_equal(buffer.observations["ram"], [FRACTIONS.astype(np.uint8), FRACTIONS])


def test_integers_stay_as_small_as_their_space_has_them() -> None:
    buffer = GAERolloutBuffer(2, WHOLE, spaces.MultiBinary(2), n_envs=2, device="cpu")
    no = np.zeros(2, dtype=bool)
    buffer.add_step(np.full((2, 2), 200, dtype=np.uint8), np.ones((2, 2), dtype=np.float32), np.zeros(2), no, no, no)
    assert (buffer.observations.dtype, buffer.actions.dtype) == (np.uint8, np.int8)
