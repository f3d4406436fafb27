"""The commands of ``python -m sb3_gae.sweep``."""

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from sb3_gae.sweep.arguments import make_parser, selection_of
from sb3_gae.sweep.cost import estimate_cost
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.export import SUFFIXES, export
from sb3_gae.sweep.figures import draw
from sb3_gae.sweep.ledger import Status
from sb3_gae.sweep.machine import check_jobs
from sb3_gae.sweep.plan import Options, Plan, check_seeds, default_name, make_cells
from sb3_gae.sweep.presets import find_preset
from sb3_gae.sweep.report import failures, overview, running
from sb3_gae.sweep.results import NO_PARQUET, read_results, results_of
from sb3_gae.sweep.runner import check_plan, run_plan, standings_of
from sb3_gae.sweep.runs import combine, runs_of
from sb3_gae.sweep.storage import holds
from sb3_gae.sweep.study import SweepStudy, default_location
from sb3_gae.sweep.take_in import take_in

#: for the shell
_FAILED_CELLS, _BAD_INPUT, _STOPPED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: of the command line; None for those of this process
    :return: exit status: 0, or 1 if cells failed, 2 after bad input, 130 if it was stopped
    """
    try:
        args = make_parser().parse_args(arguments)
        return _COMMANDS[args.command](args)
    except SweepError as error:
        print(f"sb3_gae.sweep: {error}", file=sys.stderr)
        return _BAD_INPUT
    except KeyboardInterrupt:
        return _STOPPED


def _run(args: argparse.Namespace) -> int:
    check_jobs(args.jobs)
    plan = _plan_of(args)
    if args.dry_run:
        return _dry_run(plan, args.jobs)
    table = run_plan(plan, args.jobs, retry_failed=args.retry_failed, progress=not args.no_progress, wait=args.wait)
    print(overview(plan.name, table))
    statuses = {standing.status for standing in table.values()}
    if Status.RUNNING in statuses:
        print(running(table) + "Other processes run these; --wait stays until they are done, and takes over what is lost.")
    print(failures(table), end="")
    if Status.FAILED in statuses:
        return _FAILED_CELLS
    return _STOPPED if statuses & {Status.WAITING, Status.MISSING} else 0


def _plan_of(args: argparse.Namespace) -> Plan:
    seeds = None if args.seeds is None else range(args.first_seed, args.first_seed + check_seeds(args.seeds))
    if seeds is None and args.first_seed:
        raise SweepError("`first-seed` needs --seeds, the number of them.")
    cells = make_cells(
        args.preset,
        env=args.env,
        gammas=args.gammas,
        lambdas=args.lambdas,
        conditions=args.conditions,
        seeds=seeds,
        iterations=args.iterations,
        hyperparams=args.hyperparams,
    )
    name = args.name or default_name(args.preset, (cell.task for cell in cells))
    options = Options(args.conf_file, tuple(args.gym_packages), args.threads, args.device)
    return Plan(name, args.storage, tuple(cells), options, args.silent_after)


def _dry_run(plan: Plan, jobs: int) -> int:
    check_plan(plan)
    location = plan.location or default_location(plan.name)
    # Opening what is not there would make it
    study = SweepStudy(plan.name, location, create=False) if holds(location, plan.name) else None
    table = standings_of(study, plan)
    print(overview(plan.name, table))
    for cost in estimate_cost(plan, table):
        print(f"{cost.task}: {cost.cells} cells with {cost.iterations} iterations left")
        # A cell is not shared: the last ones may leave jobs without work
        share = math.ceil(cost.cells / jobs) / cost.cells
        print(f"  {_time_range(cost.low * share, cost.high * share)} in {jobs} job(s), from {cost.basis}")
    return 0


def _time_range(low: float, high: float) -> str:
    texts = list(dict.fromkeys(_time(seconds) for seconds in (low, high)))
    return f"about {texts[0]}" if len(texts) == 1 else f"from {texts[0]} to {texts[1]}"


def _time(seconds: float) -> str:
    for size, unit in ((86_400, "days"), (3_600, "h"), (60, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"


def _status(args: argparse.Namespace) -> int:
    study = _study_of(args)
    table = study.standings()
    print(overview(study.name, table))
    print(running(table), end="")
    print(failures(table, tracebacks=args.tracebacks), end="")
    return 0


def _export(args: argparse.Namespace) -> int:
    study = _study_of(args)
    table = results_of(study, partial=args.partial)
    outputs = args.output
    if outputs is None:
        outputs = [f"logs/sweeps/{study.name}.csv", f"logs/sweeps/{study.name}.parquet"]
        if importlib.util.find_spec("pyarrow") is None:
            print(f"no Parquet file: {NO_PARQUET}", file=sys.stderr)
            outputs.pop()
    of_runs = "runs" if args.partial else "cells"
    for output in outputs:
        print(f"wrote {export(table, output)}: {len(table)} rows, {table['trial'].nunique()} {of_runs}")
    return 0


def _import(args: argparse.Namespace) -> int:
    table = combine((file, read_results(file)) for file in args.files)
    # An unknown --name begins a sweep
    study = SweepStudy(_name_of(args), args.storage)
    print(f"sweep {study.name!r}: {take_in(study, table)} of {len(list(runs_of(table)))} cells added, the others were there")
    return 0


def _figure(args: argparse.Namespace) -> int:
    table, name = _results_of(args)
    output = args.output or f"logs/sweeps/{name}_{args.kind}"
    for path in draw(args.kind, table, output, args.iteration, args.by, selection_of(args)):
        print(f"wrote {path}")
    return 0


def _rank(args: argparse.Namespace) -> int:
    table, _ = _results_of(args)
    chosen = selection_of(args).of(table)
    # Every process of a sweep would wait for rliable
    from sb3_gae.sweep.ranking import as_markdown, caution, rank_curves

    ranks = rank_curves(chosen, args.iteration, args.by)
    print(as_markdown(ranks))
    # Not into the table, which may go into a document
    if warning := caution(ranks):
        print(warning, file=sys.stderr)
    return 0


def _results_of(args: argparse.Namespace) -> tuple[pd.DataFrame, str]:
    """The table that a command names, and a name for files that are made of it."""
    if args.sources is not None:
        if args.storage is not None or args.name is not None or args.preset is not None:
            raise SweepError("`from` names files; leave out --storage, --name and --preset, or --from.")
        tables = ((file, read_results(file)) for file in args.sources)
        table = combine(tables, matters=selection_of(args).has)
        name = Path(args.sources[0]).name
        return table, next((name.removesuffix(suffix) for suffix in SUFFIXES if name.endswith(suffix)), name)
    study = _study_of(args)
    return results_of(study), study.name


def _study_of(args: argparse.Namespace) -> SweepStudy:
    return SweepStudy(_name_of(args), args.storage, create=False)


def _name_of(args: argparse.Namespace) -> str:
    if args.preset is not None:
        find_preset(args.preset)
    if name := args.name or args.preset:
        return str(name)
    raise SweepError("Which sweep? Give its --name, or the --preset it was made of.")


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": _run,
    "status": _status,
    "export": _export,
    "import": _import,
    "figure": _figure,
    "rank": _rank,
}
