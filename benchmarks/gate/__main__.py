"""
Turns red when speed or learning have got worse than what is recorded of unchanged code.

    python -m benchmarks.gate                     # some minutes; exit status 1 if a number is outside its band
    python -m benchmarks.gate --keep              # also adds the numbers to the history
    python -m benchmarks.gate record              # records anew what the bands are made from (ten minutes)
    python -m benchmarks.gate prove               # plants one fault after the other; fails unless its numbers turn red
    python -m benchmarks.gate repeat --times 20   # how often unchanged code is red
    python -m benchmarks.gate draw                # the history as a figure

A mean of learning scores may be four standard errors off, a ratio of times half above the median of what is recorded, and a
count of work 5 % above the largest of other seeds. An improvement that leaves a band, or makes one wider than need be, is to
be recorded anew, on purpose.
"""

import argparse
import datetime
from collections.abc import Sequence

from benchmarks.gate.bands import Band, verdicts
from benchmarks.gate.parts import PARTS
from benchmarks.gate.plants import PLANTS
from benchmarks.gate.records import RECORDS, add_to_history, read_records, write_records
from sb3_gae.sweep.provenance import provenance


def check(parts: Sequence[str], keep: bool = False, quiet: bool = False) -> bool:
    """
    :param parts: of the gate
    :param keep: whether to add the numbers to the history
    :param quiet: whether to print what is outside its band alone
    :return: whether every number is within its band
    """
    return not any([red_numbers(part, keep, quiet) for part in parts])


def red_numbers(part: str, keep: bool = False, quiet: bool = False) -> set[str]:
    """
    Measure, compare and print.

    :param part: of the gate
    :param keep: whether to add the numbers to the history
    :param quiet: whether to print what is outside its band alone
    :return: names of the numbers that are outside their bands
    """
    limits = PARTS[part].bands(read_records()[part])
    measured = PARTS[part].measure()
    holds = verdicts(measured, limits)
    for name, value in measured.items():
        if not (quiet and holds[name]):
            print(line(part, name, value, limits[name]), flush=True)
    if keep:
        remember(part, measured, limits)
    return {name for name, good in holds.items() if not good}


def line(part: str, name: str, value: float, band: Band) -> str:
    """:return: one number with its band, for people"""
    within = f"at most {band.high:.4g}" if band.low == 0.0 else f"from {band.low:.4g} to {band.high:.4g}"
    return f"{'ok ' if band.holds(value) else 'RED'} {name:<34} {PARTS[part].unit:<14} {value:8.4g}   {within}"


def remember(part: str, measured: dict[str, float], limits: dict[str, Band]) -> None:
    """Add numbers to the history, with today's date and the commit."""
    common = {"date": datetime.datetime.now(datetime.UTC).date().isoformat(), "commit": provenance()["commit"], "part": part}
    add_to_history(
        [
            common
            | {"name": name, "value": f"{value:.4g}", "low": f"{limits[name].low:.4g}", "high": f"{limits[name].high:.4g}"}
            for name, value in measured.items()
        ]
    )


def record(parts: Sequence[str]) -> None:
    """Record what the bands are made from; what has seeds, with others than the gate itself uses."""
    records = read_records() if RECORDS.exists() else {}
    for part in parts:
        records[part] = PARTS[part].record(records.get(part))
        # Parts are recorded at different times, and so of different commits
        records["of"] = records.get("of", {}) | {part: provenance()}
        write_records(records)


def prove(names: Sequence[str]) -> bool:
    """
    :param names: of plants
    :return: whether the gate is green without them, and the numbers of each turn red with it
    """
    parts = sorted({PLANTS[name].part for name in names})
    print("--- without a fault: nothing may be red")
    if not check(parts):
        print("Red without a fault, so nothing can be said of any.")
        return False
    missed = {name: _missed(name) for name in names}
    for name, numbers in missed.items():
        print(f"MISSED  {name}: {', '.join(numbers)} not red" if numbers else f"noticed {name}")
    return not any(missed.values())


def _missed(name: str) -> list[str]:
    plant = PLANTS[name]
    print(f"--- {name}: must turn red: {', '.join(plant.numbers)}")
    with plant.fault():
        red = red_numbers(plant.part)
    return [number for number in plant.numbers if number not in red]


def repeat(parts: Sequence[str], times: int) -> bool:
    """
    :param parts: of the gate
    :param times: how often
    :return: whether it was never red
    """
    n_red = sum(not check(parts, quiet=True) for _ in range(times))
    print(f"{n_red} of {times} runs were red")
    return n_red == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verb", nargs="?", default="check", choices=["check", "record", "prove", "repeat", "draw"])
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--plants", nargs="+", choices=list(PLANTS), default=list(PLANTS), help="of prove")
    parser.add_argument("--times", type=int, default=20, help="of repeat")
    parser.add_argument("--keep", action="store_true", help="add what check measures to the history")
    args = parser.parse_args()
    if args.verb == "record":
        record(args.parts)
        return 0
    if args.verb == "draw":
        from benchmarks.gate.history import draw

        print(draw())
        return 0
    good = {
        "check": lambda: check(args.parts, args.keep),
        "prove": lambda: prove([name for name in args.plants if PLANTS[name].part in args.parts]),
        "repeat": lambda: repeat(args.parts, args.times),
    }[args.verb]()
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
