"""The command ``python -m benchmarks.speed``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import benchmarks.speed as package
from benchmarks.peers.errors import PeersError
from benchmarks.speed import results
from benchmarks.speed.plan import cores
from benchmarks.speed.report import IMAGES, PAGE, write_report


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: of the command line
    :return: exit status
    """
    args = _parser().parse_args(arguments)
    try:
        args.command(args)
    except PeersError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed", description=package.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    quick = argparse.ArgumentParser(add_help=False)
    quick.add_argument("--quick", action="store_true", help="small sizes and few rounds; the numbers mean nothing")
    counted = argparse.ArgumentParser(add_help=False, parents=[quick])
    counted.add_argument("--threads", type=int, default=cores(), help="of torch and of the physics (%(default)s)")

    run = verbs.add_parser("run", parents=[counted], help="time every part")
    run.add_argument("--output", type=Path, default=results.SPEED)
    run.set_defaults(command=_run)
    targets = verbs.add_parser("targets", parents=[counted], help="ours and its limit in turn, where there is a target")
    targets.add_argument("--output", type=Path, default=results.TARGETS)
    targets.set_defaults(command=_targets)
    profile = verbs.add_parser("profile", parents=[counted], help="where the seconds of an iteration go")
    profile.add_argument("--output", type=Path, default=results.SECONDS)
    profile.set_defaults(command=_profile)
    threads = verbs.add_parser("threads", parents=[quick], help="an iteration with one and two threads, and with nothing set")
    threads.add_argument("--output", type=Path, default=results.THREADS)
    threads.set_defaults(command=_threads)
    report = verbs.add_parser("report", help="tables into docs/speed.md, figures into docs/images")
    report.add_argument("--results", type=Path, default=results.RESULTS, help="folder of these files (%(default)s)")
    report.add_argument("--page", type=Path, default=PAGE, help="to be filled (%(default)s)")
    report.add_argument("--images", type=Path, default=IMAGES, help="folder of the figures (%(default)s)")
    report.set_defaults(command=_report)
    return parser


# Each imports what it needs: the others would wait for it


def _run(args: argparse.Namespace) -> None:
    from benchmarks.speed.run import run

    run(args.output, args.quick, args.threads)
    print(f"wrote {args.output}")


def _targets(args: argparse.Namespace) -> None:
    from benchmarks.speed.targets import measure

    measure(args.output, args.quick, args.threads)
    print(f"wrote {args.output}")


def _profile(args: argparse.Namespace) -> None:
    from benchmarks.speed.split import profile

    profile(args.output, args.quick, args.threads)
    print(f"wrote {args.output}")


def _threads(args: argparse.Namespace) -> None:
    from benchmarks.speed.thread_counts import threads

    threads(args.output, args.quick)
    print(f"wrote {args.output}")


def _report(args: argparse.Namespace) -> None:
    for path in write_report(args.results, args.page, args.images):
        print(f"wrote {path}")
