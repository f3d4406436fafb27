"""The command line of ``python -m sb3_gae.sweep``: its arguments and what they mean."""

import argparse
from typing import Any

from rl_zoo3.utils import StoreDict

from sb3_gae.sweep.conditions import CONDITIONS
from sb3_gae.sweep.errors import SweepError, in_one_line
from sb3_gae.sweep.figures import KINDS
from sb3_gae.sweep.liveness import SILENT_AFTER
from sb3_gae.sweep.presets import PRESETS
from sb3_gae.sweep.selection import Selection
from sb3_gae.sweep.series import SCORES

_EXAMPLES = """examples:
  python -m sb3_gae.sweep run --preset small --jobs 2
  python -m sb3_gae.sweep figure heatmap --preset small
  python -m sb3_gae.sweep run --env MyEnv-v0 --gammas .96 .99 --lambdas 0 .96 1 --seeds 5 --iterations 50 \\
      --gym-packages my_module

presets:
"""


class _StoreParams(StoreDict):
    """rl-zoo3's, with errors of one line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        params: dict[str, Any] = {}
        for value in values:
            name, colon, text = value.partition(":")
            if not name or not colon or not text:
                raise SweepError(f"`-params` are written as name:value, got {value!r}.")
            try:
                super().__call__(parser, namespace, [value], option_string)
            except Exception as error:
                what = f"{type(error).__name__}: {in_one_line(error)}"
                raise SweepError(
                    f"`-params {name}` must be a value in Python, got {text} ({what}); a text needs quotes of its own, "
                    f"as in -params \"{name}:'{text}'\"."
                ) from None
            params |= getattr(namespace, self.dest)
        setattr(namespace, self.dest, params)


def make_parser() -> argparse.ArgumentParser:
    """:return: of the whole command line"""
    presets = "\n".join(f"  {name:<11} {preset.title}" for name, preset in PRESETS.items())
    parser = argparse.ArgumentParser(
        prog="python -m sb3_gae.sweep",
        description="Sweeps of gamma and lambda over tasks, seeds and conditions, and their figures.",
        epilog=_EXAMPLES + presets,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    _add_run(commands.add_parser("run", help="run the cells of a grid that are not done yet"))
    status = commands.add_parser("status", help="what is done, running, left, and failed for what reason")
    _add_study(status)
    status.add_argument("--tracebacks", action="store_true", help="where cells that failed did so, in full")
    exported = commands.add_parser("export", help="results as CSV and Parquet, a row for each seed and iteration")
    _add_study(exported)
    exported.add_argument("-o", "--output", nargs="+", help="files (default: logs/sweeps/NAME.csv and .parquet)")
    exported.add_argument(
        "--partial",
        action="store_true",
        help="also what is stored of cells that run, failed, were stopped or lost, with a column `state`; "
        "figures, rank and import take only the finished cells of such a file",
    )
    taken_in = commands.add_parser("import", help="add the finished cells of exported files to a sweep")
    taken_in.add_argument("files", nargs="+", metavar="FILE", help="CSV or Parquet")
    _add_study(taken_in)
    _add_figure(commands.add_parser("figure", help="draw a figure from stored results"))
    _add_rank(commands.add_parser("rank", help="a table of the curves, the best first, with intervals"))
    return parser


def _add_study(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--preset", metavar="PRESET", help=f"of {', '.join(PRESETS)}")
    parser.add_argument("--name", help="of the sweep (default: the preset's, or the task's)")
    parser.add_argument(
        "--storage", help="URL of a database that Optuna knows, or path of a journal (default: logs/sweeps/NAME.journal)"
    )


def _add_run(parser: argparse.ArgumentParser) -> None:
    _add_study(parser)
    parser.add_argument("--env", nargs="+", help="tasks; with a preset, in place of its own")
    parser.add_argument("--gammas", nargs="+", type=float, help="discount factors")
    parser.add_argument("--lambdas", nargs="+", type=float, help="weights of longer estimates")
    parser.add_argument("--conditions", nargs="+", help=f"of {', '.join(CONDITIONS)} (default: trust_region)")
    parser.add_argument("--seeds", type=int, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=0, help="the lowest of them (default: 0)")
    parser.add_argument("--iterations", type=int, help="batches of each run")
    parser.add_argument(
        "-params",
        "--hyperparams",
        nargs="+",
        action=_StoreParams,
        help="other hyperparameters, e.g. target_kl:0.02 vf_steps:3",
    )
    parser.add_argument("-conf", "--conf-file", help="settings file as rl-zoo3's (default: the shipped one)")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side (default: 1)")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch and physics, in each process (default: 1)")
    parser.add_argument("--device", default="auto", help="of PyTorch (default: auto)")
    parser.add_argument("--retry-failed", action="store_true", help="run cells that failed again")
    parser.add_argument("--dry-run", action="store_true", help="run nothing: what is left, and what it will cost")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")
    parser.add_argument(
        "--silent-after",
        type=float,
        default=SILENT_AFTER,
        metavar="SECONDS",
        help="without a sign of life, after which another machine's cell is taken over (default: %(default)g)",
    )
    parser.add_argument(
        "--wait", action="store_true", help="stay while other machines run cells, and take over what they lose"
    )


def _add_figure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=KINDS)
    _add_selection(parser)
    parser.add_argument("-o", "--output", help="PNG or SVG file; without an ending both (default: logs/sweeps/NAME_KIND)")
    _add_score(parser, default="last")


def _add_rank(parser: argparse.ArgumentParser) -> None:
    _add_selection(parser)
    _add_score(parser, default="training")


def _add_score(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--by",
        choices=SCORES,
        default=default,
        help=f"the return of the last iteration, or the mean over training (default: {default}; not for curves)",
    )
    parser.add_argument("--iteration", type=int, help="in place of the last (not for curves)")


def _add_selection(parser: argparse.ArgumentParser) -> None:
    """Results and which of them; :func:`selection_of` reads the latter."""
    _add_study(parser)
    parser.add_argument("--from", dest="sources", nargs="+", metavar="FILE", help="exported files, in place of a storage")
    parser.add_argument("--env", nargs="+", help="only these tasks")
    parser.add_argument("--conditions", nargs="+", help="only these")
    parser.add_argument("--gammas", nargs="+", type=float, help="only these")
    parser.add_argument("--lambdas", nargs="+", type=float, help="only these")
    parser.add_argument("--of-iterations", type=int, help="only runs of this length")


def selection_of(args: argparse.Namespace) -> Selection:
    """
    :param args: of the commands ``figure`` and ``rank``
    :return: what they choose of a table
    """
    return Selection(args.env, args.conditions, args.gammas, args.lambdas, args.of_iterations)
