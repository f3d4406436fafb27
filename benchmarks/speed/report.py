"""The results page and its figures, from the committed results and nothing else."""

from pathlib import Path
from typing import Any

from benchmarks.peers.errors import PeersError
from benchmarks.peers.page import filled
from benchmarks.speed import results, tables

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "speed.md"
IMAGES = DOCS / "images"

#: title of each figure, by the name of its file
_FIGURES = {
    "speed_growth": "Cost of each part against its size, beside peer and limit",
    "iteration_seconds": "Where the seconds of an iteration go",
}


def sections_of(folder: Path) -> dict[str, str]:
    """
    :param folder: of the files of results
    :return: Markdown by the name of the section
    """
    speed, targets, seconds, threads = _read(folder)
    return {
        "targets": tables.targets_table(targets["rows"]),
        "origin": tables.origin_list(speed),
        "growth": tables.growth_table(speed["rows"]),
        "figure growth": _shown("speed_growth", speed),
        "parts": tables.parts_table(speed["rows"]),
        "arithmetic": tables.arithmetic_table(speed["rows"]),
        "seconds": tables.seconds_table(seconds["rows"]),
        "figure seconds": _shown("iteration_seconds", seconds),
        "threads": tables.threads_table(threads["rows"]),
    }


def _read(folder: Path) -> list[dict[str, Any]]:
    return [results.read(folder / path.name) for path in (results.SPEED, results.TARGETS, results.SECONDS, results.THREADS)]


def _shown(name: str, found: dict[str, Any]) -> str:
    return f"![{_FIGURES[name]}](images/{name}.svg)" if found["rows"] else ""


def write_report(folder: Path = results.RESULTS, page: Path = PAGE, images: Path = IMAGES) -> list[Path]:
    """
    :param folder: of the files of results
    :param page: to be filled
    :param images: folder of the figures
    :return: paths of what was written
    :raises PeersError: if there are no results
    """
    found = _read(folder)
    speed, _, seconds, _ = found
    if not any(of_verb["rows"] for of_verb in found):
        raise PeersError(f"There are no results in {folder} yet; measure first: python -m benchmarks.speed run")
    # The other commands would wait for it
    from matplotlib import rc_context

    from benchmarks.speed.figures import growth_figure, seconds_figure
    from sb3_gae.sweep.figures.files import save_figure
    from sb3_gae.sweep.figures.style import STYLE

    page.write_text(filled(page.read_text(), sections_of(folder)))
    written = [page]
    images.mkdir(parents=True, exist_ok=True)
    draws = {"speed_growth": (growth_figure, speed), "iteration_seconds": (seconds_figure, seconds)}
    with rc_context(STYLE):
        for name, (draw, shown) in draws.items():
            if shown["rows"]:
                written.append(images / f"{name}.svg")
                save_figure(draw(shown["rows"]), written[-1])
    return written
