"""What one can turn in the gridworld demonstration, checked."""

from dataclasses import dataclass

from sb3_gae.checks import check_choice, check_count, check_number

#: kinds of value function
VALUE_FUNCTIONS = ("exact", "learned", "zero", "noisy", "frozen")
#: what is done first with a batch
ORDERS = ("policy_first", "value_first")

MAX_BATCH_SIZE = 200
MAX_LEARNING_RATE = 20.0


@dataclass(frozen=True)
class Controls:
    r"""
    :param gae_lambda: weight of longer estimates in [0, 1]
    :param gamma: discount factor in [0, 1]
    :param value_function: what the estimator takes for :math:`V`: the policy's ``"exact"`` values; ``"learned"`` ones, the
        mean returns of the last batch that visited a cell; ``"zero"``; ``"noisy"``, the exact ones with a fixed error in
        each cell; or ``"frozen"``, the values in use when this was chosen
    :param batch_size: episodes of a step, 1 to 200
    :param learning_rate: length of the ascent step in units of the gradient, in (0, 20]
    :param order: ``"policy_first"`` as in the paper, or ``"value_first"``, which lets a learned :math:`V` see the batch before
        the policy does
    :raises ValueError: if any of them is out of range
    """

    gae_lambda: float = 0.96
    gamma: float = 0.95
    value_function: str = "exact"
    batch_size: int = 20
    learning_rate: float = 6.0
    order: str = "policy_first"

    def __post_init__(self) -> None:
        check_number("gae_lambda", self.gae_lambda, 0.0, 1.0)
        check_number("gamma", self.gamma, 0.0, 1.0)
        check_choice("value_function", self.value_function, VALUE_FUNCTIONS)
        check_count("batch_size", self.batch_size)
        check_number("batch_size", self.batch_size, 1, MAX_BATCH_SIZE)
        check_number("learning_rate", self.learning_rate, 0.0, MAX_LEARNING_RATE, above=True)
        check_choice("order", self.order, ORDERS)
