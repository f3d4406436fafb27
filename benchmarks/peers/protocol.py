"""What is the same for every algorithm."""

#: steps of training; Humanoid too, although the zoo gives it two million
MUJOCO_STEPS = 1_000_000
MUJOCO_TASKS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Swimmer-v5", "Humanoid-v5")

#: steps of the zoo's settings for ``trpo``
CLASSIC_TASKS = {
    "CartPole-v1": 100_000,
    "Acrobot-v1": 100_000,
    "Pendulum-v1": 100_000,
    "MountainCarContinuous-v0": 50_000,
    "LunarLander-v3": 200_000,
}

LONG_STEPS = 3_000_000
#: mean return of tianshou's published PPO after three million steps, in its benchmark of the v3 tasks
PUBLISHED_PPO = {"HalfCheetah-v5": 7337.0, "Walker2d-v5": 4896.0, "Ant-v5": 4079.0}

#: evaluations in a training, beside the one before it
EVALUATIONS = 40
#: whole episodes of an evaluation, one in each environment
EPISODES = 10
#: of the first environment for evaluation; the others count on from it. The same in every evaluation of every run
FIRST_EVALUATION_SEED = 10_000
#: part of a training, its last one, whose evaluations a run's score is the mean of
SCORED_PART = 0.1


def evaluation_interval(steps: int) -> int:
    """
    :param steps: of a training
    :return: steps from one evaluation to the next; it takes place at the first update after that
    """
    return max(1, steps // EVALUATIONS)
