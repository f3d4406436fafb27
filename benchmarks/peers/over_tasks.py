"""Tables of the pages of results over all tasks."""

import pandas as pd

from benchmarks.peers.aggregates import Scores, improvement, interquartile_means, ratio
from benchmarks.peers.algorithms import ALGORITHMS, OURS, TRPO
from benchmarks.peers.comparison import (
    Runs,
    common_algorithms,
    fewest_runs,
    final_scores,
    learned,
    mujoco_runs,
    on_one_processor,
    scores_after,
    unlearned,
)
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import FEW_SEEDS
from benchmarks.peers.texts import decimal_text, is_any_former, short_title

#: parts of sb3-contrib TRPO's training time at which scores are compared
FRACTIONS = {"a fifth": 0.2, "half": 0.5, "all": 1.0}


def aggregate_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: interquartile mean over tasks, how probably ours is better, and how many times as large ours is, over all tasks
        and over those that sb3-contrib's TRPO learns
    """
    runs = mujoco_runs(table)
    scores = final_scores(runs) if runs else {}
    of_learned = final_scores(learned(runs))
    without = ", ".join(unlearned(runs))
    rows = []
    for name, mean in interquartile_means(scores).items():
        cells = [ALGORITHMS[name].title, f"{len(scores[name])} × {len(runs)}", decimal_text(mean, len(scores[name]))]
        cells += [_probably_better(scores, name), _times_as_large(scores, name)]
        rows.append([*cells, _times_as_large(of_learned, name)] if without else cells)
    heads = ["", "runs × tasks", "IQM", "probability that ours is better", "IQM of ours / its own"]
    return markdown_table([*heads, f"the same without {without}"] if without else heads, rows)


def summary(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: in a sentence or two, how far ours is ahead over the MuJoCo tasks, and of how many runs that is said
    """
    runs = mujoco_runs(table)
    if not runs:
        return ""
    scores = final_scores(runs)
    # Those of whom most is known first
    others = sorted((name for name in scores if name != OURS), key=lambda name: -len(scores[name]))
    factors = ", ".join(f"{_times_as_large(scores, name)} times that of {short_title(name)}" for name in others)
    counts = ", ".join(f"{short_title(name)} {len(scores[name])}" for name in (OURS, *others))
    fewest = fewest_runs(own[name] for own in runs.values() for name in scores)
    caution = "" if fewest >= FEW_SEEDS else " **Few runs, so little is said of chance.**"
    tasks = f"Over {len(runs)} task{'s' * (len(runs) > 1)} the interquartile mean of {short_title(OURS)} is {factors}."
    former = [task for task, own in runs.items() if is_any_former(own[OURS])]
    old = f" Ours on {', '.join(former)} are of settings that are no longer shipped." if former else ""
    return f"{tasks} {_on_learned_tasks(runs)}Runs that count on each task: {counts}.{caution}{old}"


def _on_learned_tasks(runs: Runs) -> str:
    """The same without tasks whose unit is less than what an untrained agent gets, and which weigh much for that alone."""
    if not (without := unlearned(runs)) or len(without) == len(runs):
        return ""
    peer, factor = short_title(TRPO), _times_as_large(final_scores(learned(runs)), TRPO)
    return f"Without {' and '.join(without)}, which {peer} does not learn, it is {factor} times that of {peer}. "


def clock_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: the same at equal seconds of training
    """
    runs = mujoco_runs(table)
    if not runs:
        return ""
    found = {title: scores_after(runs, fraction) for title, fraction in FRACTIONS.items()}
    means = {title: interquartile_means(scores) for title, scores in found.items()}
    rows = []
    for name in common_algorithms(on_one_processor(runs)):
        cells = []
        for title, scores in found.items():
            cells.append(decimal_text(means[title][name], len(scores[name])))
            cells.append(_probably_better(scores, name))
        n_runs = len(next(iter(found.values()))[name])
        rows.append([ALGORITHMS[name].title, f"{n_runs} × {len(on_one_processor(runs))}", *cells])
    heads = [head for title in FRACTIONS for head in (f"IQM after {title}", "ours is better")]
    return markdown_table(["", "runs × tasks", *heads], rows)


def _probably_better(scores: Scores, name: str) -> str:
    """With which probability ours is."""
    if name == OURS:
        return ""
    return decimal_text(improvement(scores[OURS], scores[name]), min(len(scores[OURS]), len(scores[name])))


def _times_as_large(scores: Scores, name: str) -> str:
    """How many times as large the interquartile mean of ours is."""
    if name == OURS or name not in scores:
        return ""
    factor = ratio(scores[OURS], scores[name], scores[TRPO])
    return decimal_text(factor, min(len(scores[OURS]), len(scores[name])))
