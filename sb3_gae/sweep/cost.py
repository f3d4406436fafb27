"""What a grid will cost, before it is run."""

from collections.abc import Sequence
from typing import NamedTuple

from sb3_gae.errors import NumericalError
from sb3_gae.sweep.errors import SweepError, in_one_line
from sb3_gae.sweep.experiment import Experiment
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.ledger import Standing, Status
from sb3_gae.sweep.plan import Plan
from sb3_gae.sweep.recorder import Row


class Cost(NamedTuple):
    """
    :param task: id of the environment
    :param cells: that are left
    :param iterations: that are left
    :param low: seconds of one process
    :param high: seconds, where batches of whole episodes grow to their full length
    :param basis: what the estimate rests on
    """

    task: str
    cells: int
    iterations: int
    low: float
    high: float
    basis: str


def estimate_cost(plan: Plan, table: dict[str, Standing]) -> list[Cost]:
    """
    :param plan: what to run
    :param table: where its cells stand, by key
    :return: for each task with cells left; from cells that are done, else from two iterations that are run here
    """
    left = [cell for cell in plan.cells if table[cell.key].status not in (Status.DONE, Status.FAILED)]
    costs = []
    for task in dict.fromkeys(cell.task for cell in left):
        own = [cell for cell in left if cell.task == task]
        measured = _from_finished(task, own, table)
        costs.append(measured if measured is not None else _from_probe(own, plan))
    return costs


def _from_finished(task: str, left: Sequence[Cell], table: dict[str, Standing]) -> Cost | None:
    done = [
        standing.trial.user_attrs
        for standing in table.values()
        if standing.status == Status.DONE and standing.trial is not None and standing.trial.user_attrs["cell"]["task"] == task
    ]
    if not done:
        return None
    chunks = [chunk["seconds"] for stored in done for name, chunk in stored.items() if name.startswith("rows:")]
    iterations = sum(map(len, chunks))
    # None where a cell was imported that had none
    setup = sum(stored.get("setup_seconds") or 0.0 for stored in done) / len(done)
    each = sum(map(sum, chunks)) / iterations
    n_iterations = sum(cell.iterations for cell in left)
    seconds = each * n_iterations + setup * len(left)
    return Cost(task, len(left), n_iterations, seconds, seconds, f"{len(done)} cells that are done, {each:.3g} s an iteration")


def _from_probe(left: Sequence[Cell], plan: Plan) -> Cost:
    cell = left[0]
    probe = Cell(cell.task, cell.condition, cell.gamma, cell.gae_lambda, cell.seed, 2, cell.overrides)
    rows: list[Row] = []
    try:
        experiment = Experiment(probe, plan.options)
        experiment.run(rows.append)
    except (ValueError, TypeError, NumericalError) as error:
        raise SweepError(f"The first of its cells, {cell}, cannot be run: {in_one_line(error)}") from error
    each = rows[-1]["seconds"]
    steps = rows[-1]["timesteps"] - rows[0]["timesteps"]
    # Episodes lengthen as the policy learns, up to the most that the settings allow
    longest = each * max(1.0, experiment.largest_batch / steps)
    n_iterations = sum(cell.iterations for cell in left)
    return Cost(
        cell.task,
        len(left),
        n_iterations,
        each * n_iterations,
        longest * n_iterations,
        f"an iteration that took {each:.3g} s for {steps:.0f} steps, of at most {experiment.largest_batch}",
    )
