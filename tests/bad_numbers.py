"""Numbers that are not finite, and what must happen when one appears in training."""

import math

import pytest
from envs_for_tests import differing, state_of, train_once

from sb3_gae import TRPOGAE, NumericalError

BAD = [math.nan, math.inf, -math.inf]


def check_refused(model: TRPOGAE, message: str) -> None:
    """The next iteration fails with this message and moves nothing, the scale of the values included."""
    before = state_of(model.policy)
    with pytest.raises(NumericalError, match=message):
        train_once(model)
    assert differing(before, state_of(model.policy)) == []
