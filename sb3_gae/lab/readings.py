"""What a moment of the demonstration shows: a row of numbers, the colour of the bias light, how the climb goes."""

from collections.abc import Sequence
from typing import NamedTuple

from sb3_gae.lab.moment import Moment

#: from this part of the best possible return on a policy counts as optimal; a softmax policy never quite gets to 1
OPTIMAL_SCORE = 0.95
#: a climb that in so many steps closed less than this part of its distance from the best return has stalled
STALL_STEPS, STALL_PART = 20, 0.05
#: upper ends of the angles, in radians, that count as none and as a slight bias
UNBIASED_ANGLE, SLIGHT_ANGLE = 0.02, 0.3


class Reading(NamedTuple):
    """
    :param step: how many steps were taken
    :param score: expected discounted return in units of the best possible
    :param bias_angle: between expected and true gradient, in radians; not a number where either vanishes
    :param variance: of the batch's gradient, exact
    :param share_of_gradient: component of the batch's gradient along the true one, in units of its length
    """

    step: int
    score: float
    bias_angle: float
    variance: float
    share_of_gradient: float


def read(moment: Moment) -> Reading:
    """
    :param moment: any
    :return: its numbers
    """
    return Reading(moment.step, moment.score, moment.bias_angle, moment.variance, moment.share_of_gradient)


def light(bias_angle: float) -> str:
    """
    :param bias_angle: in radians; not a number where there is no direction to speak of
    :return: ``"unbiased"``, ``"slight"`` or ``"biased"``
    """
    if bias_angle <= UNBIASED_ANGLE:
        return "unbiased"
    return "slight" if bias_angle <= SLIGHT_ANGLE else "biased"


def status(scores: Sequence[float]) -> str:
    """
    :param scores: since the controls were last touched, the present one last
    :return: ``"optimal"``, ``"stalled"`` or ``"climbing"``; for lack of evidence a short run is climbing
    """
    if scores[-1] >= OPTIMAL_SCORE:
        return "optimal"
    if len(scores) <= STALL_STEPS:
        return "climbing"
    before = scores[-STALL_STEPS - 1]
    return "stalled" if scores[-1] - before < STALL_PART * (1.0 - before) else "climbing"
