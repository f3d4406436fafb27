"""A gridworld small enough that the policy gradient, and bias and variance of its estimates, are known exactly."""

from sb3_gae.gridworld.exact import GradientMoments, LambdaCurve, TabularPolicy, angle
from sb3_gae.gridworld.model import MOVE_NAMES, MOVES, TabularMDP, gridworld, optimal_values
from sb3_gae.gridworld.response import lagged_gradients, response_function
from sb3_gae.gridworld.sampling import (
    Episodes,
    episode_advantages,
    episode_deltas,
    episode_gradients,
    fitted_values,
    sample_episodes,
)
from sb3_gae.gridworld.value_errors import ExactValueErrors, exact_value_errors

__all__ = [
    "MOVES",
    "MOVE_NAMES",
    "Episodes",
    "ExactValueErrors",
    "GradientMoments",
    "LambdaCurve",
    "TabularMDP",
    "TabularPolicy",
    "angle",
    "episode_advantages",
    "episode_deltas",
    "episode_gradients",
    "exact_value_errors",
    "fitted_values",
    "gridworld",
    "lagged_gradients",
    "optimal_values",
    "response_function",
    "sample_episodes",
]
