"""
How long an iteration of 200 000 quadruped steps takes with 1 to 256 workers, by a model of measured costs.

    python benchmarks/ray_speed.py                                  # measures them
    python benchmarks/ray_scaling_model.py                          # the table, for a network of 10 Gbit/s
    python benchmarks/ray_scaling_model.py --gigabits 1 --cores 16  # another network; machines of 16 cores each

The workers' part is divided by their number. The learner's is not: it sends the weights to each machine, takes in all
shares, puts them into its buffer, and updates. Where its part is the longer one, the learner is the limit: from there on
all further workers together cannot halve the time of an iteration.

What the model leaves out: machines of unlike speed, of which the slowest counts; episodes of unlike cost; and that a
machine with all its cores at work may run each of them slower than the measured one.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from statistics import linear_regression, median
from typing import NamedTuple

RESULTS = Path(__file__).parent / "results" / "ray_speed.csv"
WORKERS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
BATCH = 200_000


class Costs(NamedTuple):
    """
    :param worker_seconds: that one worker takes for a step of one environment: physics, policy, and handing it over
    :param learner_seconds: that the learner takes for a step, to take it in, put it into its buffer and show it to callbacks
    :param update_seconds: of values, advantages and update of a whole batch
    :param weights_bytes: that each machine gets
    :param step_bytes: that a step brings back
    :param worker_overhead: seconds of an iteration for each worker, however few its steps are. An upper bound, since it is
        measured where workers share the cores of one machine
    """

    worker_seconds: float
    learner_seconds: float
    update_seconds: float
    weights_bytes: float
    step_bytes: float
    worker_overhead: float


class Iteration(NamedTuple):
    """
    :param workers: number of workers
    :param collecting: seconds in which workers collect, all at once
    :param network: seconds in which weights and shares are on their way to and from the learner's machine
    :param learner: seconds of the learner alone
    """

    workers: int
    collecting: float
    network: float
    learner: float

    @property
    def seconds(self) -> float:
        """Of the whole iteration."""
        return self.collecting + self.network + self.learner

    @property
    def learner_is_the_limit(self) -> bool:
        """Whether what more workers cannot shorten is the longer part."""
        return self.network + self.learner >= self.collecting


def predict(costs: Costs, workers: int, batch: int, bytes_per_second: float, cores: int = 1) -> Iteration:
    """
    :param costs: measured
    :param workers: number of workers
    :param batch: steps of an iteration
    :param bytes_per_second: that the network of the learner's machine carries, in each direction
    :param cores: workers on each machine, which gets the weights once
    :return: how long the parts of an iteration take
    """
    machines = -(-workers // cores)
    # The slowest worker has a step more than others where they do not divide
    steps_of_a_worker = -(-batch // workers)
    carried = machines * costs.weights_bytes + batch * costs.step_bytes
    return Iteration(
        workers=workers,
        collecting=steps_of_a_worker * costs.worker_seconds,
        network=carried / bytes_per_second,
        learner=workers * costs.worker_overhead + batch * costs.learner_seconds + costs.update_seconds,
    )


def first_at_limit(costs: Costs, batch: int, bytes_per_second: float, cores: int = 1) -> int | None:
    """
    :return: the smallest number of workers, up to one for each step, with which the learner is the limit; None if none is
    """
    low, high = 1, batch
    if not predict(costs, high, batch, bytes_per_second, cores).learner_is_the_limit:
        return None
    # More workers shorten their part and never the other
    while low < high:
        middle = (low + high) // 2
        if predict(costs, middle, batch, bytes_per_second, cores).learner_is_the_limit:
            high = middle
        else:
            low = middle + 1
    return low


def costs_from(rows: Sequence[dict[str, str]], task: str) -> Costs:
    """
    :param rows: of ``ray_speed.csv``
    :param task: id
    :return: medians over the rounds with the fewest workers; what a worker adds from batches of a few steps
    :raises ValueError: if there are no rows of workers for the task
    """
    of_workers = [row for row in rows if row["task"] == task and row["way"] == "ray workers"]
    if not of_workers:
        raise ValueError(f"There are no rows of {task} with workers; run benchmarks/ray_speed.py first.")
    overhead = seconds_of_a_worker([row for row in rows if row["way"] == "messages"])
    fewest = min(int(row["workers"]) for row in of_workers)
    chosen = [row for row in of_workers if int(row["workers"]) == fewest]

    def typical(*names: str) -> float:
        return median(sum(float(row[name]) for name in names) for row in chosen)

    batch = float(chosen[0]["batch"])
    on_the_way = median(max(0.0, float(row["collection_s"]) - float(row["worker_s"])) for row in chosen)
    replay = median(float(row["rollout_s"]) - float(row["collection_s"]) for row in chosen)
    return Costs(
        worker_seconds=typical("worker_s") * fewest / batch,
        learner_seconds=(replay + max(0.0, on_the_way - fewest * overhead)) / batch,
        update_seconds=typical("update_s"),
        weights_bytes=typical("weights_bytes"),
        step_bytes=typical("shares_bytes", "states_bytes") / batch,
        worker_overhead=overhead,
    )


def seconds_of_a_worker(rows: Sequence[dict[str, str]]) -> float:
    """
    :param rows: of ``ray_speed.csv``, of batches of a few steps with several numbers of workers
    :return: slope of the straight line through the medians of what they took to collect
    :raises ValueError: if there are not at least two numbers of workers
    """
    seconds: dict[int, list[float]] = {}
    for row in rows:
        seconds.setdefault(int(row["workers"]), []).append(float(row["collection_s"]))
    if len(seconds) < 2:
        raise ValueError("There are no rows of messages; run benchmarks/ray_speed.py first.")
    medians = {workers: median(times) for workers, times in seconds.items()}
    return linear_regression(list(medians), list(medians.values())).slope


def table(iterations: Sequence[Iteration], batch: int) -> str:
    """
    :param iterations: predicted, the first of them to compare with
    :param batch: steps of an iteration
    :return: in Markdown
    """
    lines = [
        "| workers | collecting (s) | network (s) | learner (s) | iteration (s) | steps/s | speed-up | the limit |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for one in iterations:
        lines.append(
            f"| {one.workers} | {one.collecting:.2f} | {one.network:.2f} | {one.learner:.2f} | {one.seconds:.2f} | "
            f"{batch / one.seconds:.0f} | {iterations[0].seconds / one.seconds:.2f} | "
            f"{'learner' if one.learner_is_the_limit else 'workers'} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS, help="what benchmarks/ray_speed.py wrote")
    parser.add_argument("--task", default="GaeQuadruped-v0")
    parser.add_argument("--batch", type=int, default=BATCH, help="steps of an iteration")
    parser.add_argument("--gigabits", type=float, default=10.0, help="a second, of the network of the learner's machine")
    parser.add_argument("--cores", type=int, default=1, help="workers on a machine")
    args = parser.parse_args()
    with args.results.open(newline="") as file:
        costs = costs_from(list(csv.DictReader(file)), args.task)
    bytes_per_second = args.gigabits * 1e9 / 8
    print(f"{args.task}, {args.batch} steps an iteration, {args.gigabits:g} Gbit/s, {args.cores} worker(s) on a machine")
    for name, value in costs._asdict().items():
        print(f"  {name}: {value:.4g}")
    print(table([predict(costs, workers, args.batch, bytes_per_second, args.cores) for workers in WORKERS], args.batch))
    limit = first_at_limit(costs, args.batch, bytes_per_second, args.cores)
    print(f"The learner is the limit from {limit} workers on." if limit else "The learner is never the limit.")


if __name__ == "__main__":
    main()
