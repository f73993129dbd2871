"""The house's page: every room with its own first line, and the rooms that it imports from.

Rooms are the packages of `tuner` and what stands beside them; their order is the import contract of
``pyproject.toml``, from what a user meets down to arithmetic.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

from docs.generate.text import GENERATED, cell

ROOT = Path(__file__).parents[2]

INTRO = """# The house

Three packages and the data that ships with them. A room imports from rooms below it alone: the
order is a contract that `make lint` checks (`import-linter`), and this page is drawn from the
imports.

| room | what it is | imports from |
|---|---|---|
"""

REST = """
- `sim_jax/` opens no file, prints nothing and knows nothing of `tuner`. `lanes/` knows nothing of
  flying: a rule of it holds for any function.
- A reader (`recordings/`) knows nothing of the simulator; `engine/` knows nothing of what is
  computed; `service/` reads no recording in the server's own process.
- A term is kept for what it predicts, not for what it gains in the fit (`terms/`). An export passes
  its gates (`exporters/`). Sentences are made from codes and numbers when they are rendered.
- `configs/`, `reference_flights/` and `examples/` are what a user reads and edits. `tests/` mirrors
  the packages; `benchmarks/` measures speed, prediction, truth and this house
  (`python -m benchmarks.house`).
"""


def rooms() -> list[str]:
    """Return the rooms as dotted names, a user's first."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (c for c in project["tool"]["importlinter"]["contracts"] if c["type"] == "layers")
    layers: list[str] = contract["layers"]
    return layers


def statements(file: Path) -> Iterator[ast.stmt]:
    """Yield a file's statements, wherever in it they stand."""
    left: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
    while left:
        node = left.pop()
        if isinstance(node, ast.stmt):
            yield node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            inside = getattr(node, field, None)
            left += inside if isinstance(inside, list) else ()


def imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports from, wherever in it that stands."""
    for node in statements(file):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def files_of(room: str, root: Path = ROOT) -> list[Path]:
    """Return a room's source files."""
    place = root / room.replace(".", "/")
    return sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]


def arrows(root: Path = ROOT) -> dict[str, list[str]]:
    """Return room -> the rooms that it imports from, in the order of rooms."""
    order = rooms()
    found: dict[str, list[str]] = {}
    for room in order:
        names = {name for file in files_of(room, root) for name in imported(file)}
        found[room] = [
            other
            for other in order
            if other != room and any(n == other or n.startswith(f"{other}.") for n in names)
        ]
    return found


def house_page() -> str:
    """Return the page."""
    rows = []
    for room, below in arrows().items():
        first = files_of(room)[0]
        docstring = ast.get_docstring(ast.parse(first.read_text(encoding="utf-8"))) or ""
        name = room.replace(".", "/") + ("/" if first.name == "__init__.py" else ".py")
        others = " ".join(f"`{other.removeprefix('tuner.')}`" for other in below)
        rows.append(f"| `{name}` | {cell(docstring.split(chr(10))[0])} | {others} |\n")
    return f"{GENERATED}{INTRO}{''.join(rows)}{REST}"
