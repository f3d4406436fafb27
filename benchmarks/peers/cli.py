"""The command ``python -m benchmarks.peers``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import benchmarks.peers as package
from benchmarks.peers.cost import SPEEDS, read_speeds
from benchmarks.peers.errors import PeersError
from benchmarks.peers.journal import State
from benchmarks.peers.places import RESULTS
from benchmarks.peers.plan import PRESETS, Cell, cells_of
from benchmarks.peers.pool import Options, Pool, check_libraries
from benchmarks.peers.progress import Bar, Standing, left_of, standings, summary
from benchmarks.peers.protocol import CLASSIC_TASKS, MUJOCO_TASKS

#: all that the page of results has
DEFAULT_PRESETS = ("classic", "mujoco", "mujoco-3m", "ablation")

#: states of runs that are not run again unless that is asked for
_AGAIN = (State.FAILED, State.STALE, State.COMMITTED)

#: of the environment that `make bench-full` makes
TIANSHOU_PYTHON = ".venv-tianshou/bin/python"


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: of the command line
    :return: exit status
    """
    args = _parser().parse_args(arguments)
    try:
        return int(args.command(args))
    except PeersError as error:
        print(error, file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=package.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--logs", type=Path, default=Path("logs/peers"), help="folder of all runs (%(default)s)")
    shared.add_argument("--results", type=Path, default=RESULTS, help="folder of the committed files (%(default)s)")
    plan = argparse.ArgumentParser(add_help=False, parents=[shared])
    plan.add_argument("--preset", nargs="+", choices=list(PRESETS), default=list(DEFAULT_PRESETS), help="(%(default)s)")
    plan.add_argument("--tasks", nargs="+", help="only these")
    plan.add_argument("--algorithms", nargs="+", help="only these")
    plan.add_argument("--variants", nargs="+", help="only these, of the ablation or of tuning")
    plan.add_argument("--seeds", nargs="+", type=int, help="only these")
    plan.add_argument("--jobs", type=int, default=1, help="runs side by side, each on a core of its own (%(default)s)")

    run = verbs.add_parser("run", parents=[plan], help="run what is left")
    run.add_argument("--dry-run", action="store_true", help="only say what is left and how long it takes")
    run.add_argument("--again", nargs="+", choices=list(map(str, _AGAIN)), default=[], help="also runs that are that")
    run.add_argument("--no-pin", action="store_true", help="do not keep runs to a core each")
    run.add_argument(
        "--tianshou-python",
        default=TIANSHOU_PYTHON if Path(TIANSHOU_PYTHON).exists() else sys.executable,
        help="interpreter that has tianshou (%(default)s)",
    )
    run.set_defaults(command=_run)
    verbs.add_parser("status", parents=[plan], help="where the runs stand").set_defaults(command=_status)
    exported = verbs.add_parser("export", parents=[shared], help="gather what is done into the committed files")
    exported.set_defaults(command=_export)
    verbs.add_parser("report", help="tables into README.md and docs, figures into docs/images").set_defaults(command=_report)
    speeds = verbs.add_parser("measure", help="speeds, for the estimate of a dry run")
    speeds.add_argument("--tasks", nargs="+", default=[*CLASSIC_TASKS, *MUJOCO_TASKS])
    speeds.add_argument("--output", type=Path, default=SPEEDS)
    speeds.set_defaults(command=_measure)
    return parser


def _chosen(args: argparse.Namespace) -> list[Cell]:
    if args.jobs < 1:
        raise PeersError(f"`jobs` must be at least 1, got {args.jobs}.")
    wanted = {"task": args.tasks, "algorithm": args.algorithms, "variant": args.variants, "seed": args.seeds}
    cells = cells_of(args.preset)
    for name, values in wanted.items():
        if values is not None:
            known = {getattr(cell, name) for cell in cells}
            if unknown := [value for value in values if value not in known]:
                held = ", ".join(map(str, sorted(known)))
                raise PeersError(f"`{name}s`: the preset has no {unknown[0]}; it has {held}.")
            cells = [cell for cell in cells if getattr(cell, name) in values]
    return cells


def _standings(args: argparse.Namespace) -> list[Standing]:
    # The help need not wait for pandas
    from benchmarks.peers.table import committed_settings

    return standings(_chosen(args), args.logs, committed_settings(args.results))


def _run(args: argparse.Namespace) -> int:
    table = _standings(args)
    left = left_of(table, [State(name) for name in args.again])
    print(summary(table, left, read_speeds(), args.jobs), flush=True)
    if args.dry_run or not left:
        return 0
    options = Options(args.logs, args.jobs, not args.no_pin, {"tianshou": args.tianshou_python})
    check_libraries(left, options)
    bar = Bar(left, args.logs)
    try:
        problems = Pool(left, options, bar.show).run()
    finally:
        bar.close()
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


def _status(args: argparse.Namespace) -> int:
    table = _standings(args)
    for one in table:
        print(f"{one.state:<10} {min(one.record.steps, one.cell.steps):>9} of {one.cell.steps:>9} steps  {one.cell.name}")
    print(summary(table, left_of(table), read_speeds(), args.jobs))
    return 0


def _export(args: argparse.Namespace) -> int:
    from benchmarks.peers.table import export, gather

    table, failures = gather(args.logs)
    for failure in failures:
        print(f"not exported, since it failed: {failure}", file=sys.stderr)
    exported = export(table, args.results)
    print("\n".join([*exported.notes, *(f"wrote {path}" for path in exported.paths)]))
    return 0


def _report(args: argparse.Namespace) -> int:
    from benchmarks.peers.report import write_report

    written = write_report()
    print("\n".join([*written.notes, *(f"wrote {path}" for path in written.paths)]))
    return 0


def _measure(args: argparse.Namespace) -> int:
    from benchmarks.peers.measure import measure

    measure(args.output, args.tasks)
    return 0
