"""The algorithms, and which library runs them."""

from typing import NamedTuple

OURS, TRPO, PPO, A2C = "trpo_gae", "trpo", "ppo", "a2c"
TIANSHOU_TRPO, TIANSHOU_NPG = "tianshou_trpo", "tianshou_npg"


class Algorithm(NamedTuple):
    """
    :param title: for people
    :param library: ``zoo`` or ``tianshou``
    :param colour: in figures, one that people with any colour vision tell from the others
    :param dash: in figures
    """

    title: str
    library: str
    colour: str
    dash: str


ALGORITHMS = {
    OURS: Algorithm("TRPOGAE (ours)", "zoo", "#d55e00", "-"),
    TRPO: Algorithm("TRPO, sb3-contrib", "zoo", "#0072b2", "-"),
    PPO: Algorithm("PPO, SB3", "zoo", "#009e73", "--"),
    A2C: Algorithm("A2C, SB3", "zoo", "#cc79a7", "-."),
    TIANSHOU_TRPO: Algorithm("TRPO, tianshou", "tianshou", "#56b4e9", "--"),
    TIANSHOU_NPG: Algorithm("NPG, tianshou", "tianshou", "#7f7f7f", ":"),
}

#: what is imported of each library
MODULES = {"zoo": "rl_zoo3", "tianshou": "tianshou"}
