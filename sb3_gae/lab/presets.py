"""Settings that show something, each with a promise that the tests hold it to."""

from typing import NamedTuple

from sb3_gae.lab.controls import Controls
from sb3_gae.lab.simulation import Simulation


class Preset(NamedTuple):
    """
    :param title: on its button
    :param story: what to do and what to look at
    :param controls: to begin with
    :param seed: of its run
    """

    title: str
    story: str
    controls: Controls
    seed: int = 0


PRESETS = {
    "sweet_spot": Preset(
        "The paper's sweet spot",
        "With a good value function and λ at 0.96, the advantage estimate has low bias and low variance. "
        "Press play and watch the return climb fast and smooth to optimal while the bias light stays green.",
        Controls(gae_lambda=0.96, value_function="exact", batch_size=20, learning_rate=6.0),
    ),
    "broken_v": Preset(
        "One-step on a broken V",
        "λ is 0 and the value function says zero everywhere, so a move is judged by its own reward alone. Press play: the "
        "bias light is red and the return stalls far below the dashed ceiling. Then drag λ up to 1: the bias falls and the "
        "climb restarts, although V is as broken as before.",
        Controls(gae_lambda=0.0, value_function="zero", batch_size=20, learning_rate=4.0),
    ),
    "monte_carlo": Preset(
        "Monte Carlo",
        "λ is 1 and the value function is wrong. The estimate is the whole return, so the bias light stays green whatever V "
        "says; but the variance runs high and the curve jitters. Turn V to exact, or λ down a little, and see it calm down.",
        Controls(gae_lambda=1.0, value_function="noisy", batch_size=20, learning_rate=6.0),
        seed=8,
    ),
    "value_first": Preset(
        "Value fit first",
        "One episode a step, and the value function is fitted to it before the policy's step. It then explains the very "
        "returns that the policy should learn from: little of the gradient is left, and the policy creeps. The bias light "
        "cannot see it, as it judges V before the fit; the share of the true gradient can. Switch the order to policy first, "
        "as the paper does.",
        Controls(gae_lambda=0.96, value_function="learned", batch_size=1, learning_rate=1.0, order="value_first"),
        seed=1,
    ),
}


def load_preset(name: str) -> Simulation:
    """
    :param name: a key of :data:`PRESETS`
    :return: at step 0, the same each time
    :raises ValueError: if there is none of that name
    """
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {', '.join(PRESETS)}, got {name!r}.")
    return Simulation(PRESETS[name].controls, PRESETS[name].seed)
