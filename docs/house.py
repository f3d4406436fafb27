"""
Draws the rooms of the package and who imports whom, as docs/images/house.svg, from the imports themselves.

    python docs/house.py

A room is a folder or a single file of sb3_gae; the commands (``__main__``) are a room of their own. An arrow means that
the upper room imports the lower one; those that follow from others are left out. A test fails when the picture is not that
of the code.
"""

import ast
import itertools
from collections.abc import Iterator, Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "sb3_gae"
PICTURE = Path(__file__).parent / "images" / "house.svg"
COMMANDS = "python -m"

Edges = Mapping[str, set[str]]
#: a room and nothing, or where the arrow from one to another passes a floor
Node = tuple[str, ...]

WIDTH, ROW, HEIGHT, MARGIN, PASSAGE = 146, 84, 34, 14, 20
SWEEPS = 8
# Boxes bring their own light ground and arrows are grey: so it reads on white and on dark
STYLE = """
  .room { fill: #d9e8f5; stroke: #4a7ba6; } .file { fill: #f6f4ee; stroke: #999; } text { fill: #222; }
  .arrow { fill: none; stroke: #8a8a8a; } .head { fill: #8a8a8a; }
  text { font: 13px sans-serif; text-anchor: middle; }"""


def room_of(file: Path) -> str:
    """
    :param file: of the package, relative to it
    :return: its room
    """
    if file.name == "__main__.py":
        return COMMANDS
    return file.parts[0] if len(file.parts) > 1 else file.stem.replace("__init__", "sb3_gae")


def imported_by(file: Path) -> Iterator[str]:
    """
    :param file: of the package
    :return: the first name below ``sb3_gae`` of everything that it imports from there
    """
    for node in ast.walk(ast.parse(file.read_text())):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "sb3_gae" else [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name.split(".")[1] for name in names if name.startswith("sb3_gae.") and name != "sb3_gae.__version__")


def rooms(package: Path = PACKAGE) -> dict[str, set[str]]:
    """
    :param package: folder
    :return: for each room those that it imports
    """
    edges: dict[str, set[str]] = {}
    for file in sorted(package.rglob("*.py")):
        room = room_of(file.relative_to(package))
        edges.setdefault(room, set()).update(set(imported_by(file)) - {room})
    return edges


def without_shortcuts(edges: Edges) -> dict[str, set[str]]:
    """
    :param edges: without a ring
    :return: those that do not follow from others
    :raises graphlib.CycleError: if there is a ring
    """
    reached: dict[str, set[str]] = {}
    for room in TopologicalSorter(edges).static_order():
        reached[room] = set().union(*({below} | reached[below] for below in edges.get(room, ())))
    return {
        room: {below for below in belows if not any(below in reached[other] for other in belows)}
        for room, belows in edges.items()
    }


def floors(edges: Edges) -> list[list[str]]:
    """
    :param edges: without a ring
    :return: rooms by floor, the cellar last: each above all that it imports
    """
    height: dict[str, int] = {}
    for room in TopologicalSorter(edges).static_order():
        height[room] = 1 + max((height[below] for below in edges.get(room, ())), default=-1)
    found: list[list[str]] = [[] for _ in range(max(height.values()) + 1)]
    for room in sorted(height):
        found[-1 - height[room]].append(room)
    return found


def chains(edges: Edges) -> list[list[Node]]:
    """
    :param edges: without a ring
    :return: for each import the upper room, the floors that its arrow passes between other rooms, and the lower room
    """
    floor_of = {room: number for number, row in enumerate(floors(edges)) for room in row}
    return [
        [(upper, ""), *((upper, lower, str(floor)) for floor in range(floor_of[upper] + 1, floor_of[lower])), (lower, "")]
        for upper in sorted(edges)
        for lower in sorted(edges[upper])
    ]


def places(edges: Edges) -> dict[Node, tuple[float, float]]:
    """
    :param edges: without a ring
    :return: the middle of each room's box, and where arrows pass a floor, in pixels
    """
    rows: list[list[Node]] = [[(room, "") for room in row] for row in floors(edges)]
    steps = [step for chain in chains(edges) for step in itertools.pairwise(chain)]
    for chain in chains(edges):
        for node in chain[1:-1]:
            rows[int(node[2])].append(node)
    x = {node: float(place) for row in rows for place, node in enumerate(row)}
    widest = max(sum(map(_room_for, row)) for row in rows)
    # From the roof to the cellar and back, each time to the middle of the neighbours: few arrows cross then
    for sweep in range(SWEEPS):
        ends = sweep % 2
        for row in rows if ends == 0 else reversed(rows):
            near = {node: [x[step[ends]] for step in steps if step[1 - ends] == node] for node in row}
            row.sort(key=lambda node: (sum(near[node]) / len(near[node]) if near[node] else x[node], node))
            left = (widest - sum(map(_room_for, row))) / 2
            for node in row:
                x[node], left = left + _room_for(node) / 2, left + _room_for(node)
    return {node: (x[node], MARGIN + number * ROW + HEIGHT / 2) for number, row in enumerate(rows) for node in row}


def _room_for(node: Node) -> int:
    return WIDTH + MARGIN if node[1] == "" else PASSAGE


def arrow(points: Sequence[tuple[float, float]]) -> str:
    """
    :param points: middle of a box, of the gaps to pass, and of the box that the arrow leads to
    :return: as SVG
    """
    (x, y), *between, (u, v) = points
    path = f"M{x:.0f} {y + HEIGHT / 2:.0f}"
    x, y = x, y + HEIGHT / 2
    for across, down in between:
        # Upright past the boxes of that floor
        for bottom in (down - HEIGHT / 2, down + HEIGHT / 2):
            path += _bend(x, y, across, bottom)
            x, y = across, bottom
    return f'<path class="arrow" marker-end="url(#head)" d="{path}{_bend(x, y, u, v - HEIGHT / 2)}"/>'


def _bend(x: float, y: float, u: float, v: float) -> str:
    return f"C{x:.0f} {(y + v) / 2:.0f} {u:.0f} {(y + v) / 2:.0f} {u:.0f} {v:.0f}"


def box(room: str, kind: str, middle: tuple[float, float]) -> str:
    """
    :param room: its name
    :param kind: ``"room"`` or ``"file"``
    :param middle: in pixels
    :return: as SVG
    """
    x, y = middle
    corner = f'x="{x - WIDTH / 2:.0f}" y="{y - HEIGHT / 2:.0f}"'
    return (
        f'<rect class="{kind}" {corner} width="{WIDTH}" height="{HEIGHT}" rx="6"/>'
        f'<text x="{x:.0f}" y="{y + 4:.0f}">{room}</text>'
    )


def picture(edges: Edges, folders: set[str]) -> str:
    """
    :param edges: see :func:`rooms`
    :param folders: rooms with several files
    :return: as SVG
    """
    few = without_shortcuts(edges)
    where = places(few)
    width = max(x for x, _ in where.values()) + WIDTH / 2 + MARGIN
    height = max(y for _, y in where.values()) + HEIGHT
    size = f'viewBox="0 0 {width:.0f} {height:.0f}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="Rooms and imports">',
        f"<style>{STYLE}\n</style>",
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path class="head" d="M0 0L8 4L0 8z"/></marker>',
        *(arrow([where[node] for node in chain]) for chain in chains(few)),
        *(box(room, "room" if room in folders else "file", where[room, ""]) for room in sorted(few)),
    ]
    return "\n".join([*lines, "</svg>", ""])


def house() -> str:
    """:return: the picture of the code as it is"""
    return picture(rooms(), {folder.name for folder in PACKAGE.iterdir() if folder.is_dir()} | {COMMANDS})


if __name__ == "__main__":
    PICTURE.write_text(house())
    print(PICTURE)
