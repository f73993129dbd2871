"""What pyproject.toml declares is imported, and what is imported is declared, extra by extra."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

#: Import packages whose distribution is named otherwise.
DISTRIBUTIONS = {"yaml": "pyyaml", "backports": "backports-zstd"}
#: Distributions that work without being imported: plugins, and what `make lint` and `docs` run.
#: psycopg is found by SQLAlchemy, from the URL of a database.
NOT_IMPORTED = {
    "psycopg",
    *("pytest-xdist", "ruff", "mypy", "import-linter", "types-pyyaml", "lxml-stubs"),
    *("mkdocs", "mkdocs-material", "mkdocstrings"),
}
#: What a test uses where somebody has installed it; why it is in no extra stands there.
WHERE_INSTALLED = {"test": {"s3fs", "moto", "h5py", "mujoco"}}
TOOLS = {"dev", "docs"}
"""Extras of nothing but those."""
OURS = {"lanes", "sim_jax", "tuner", "tests", "benchmarks", "examples", "docs"}

TARGETS = "tuner/exporters/targets"
STORE = "tuner/core/content_store.py"
#: Extra -> the folders and files that need it beside what is always installed.
USES = {
    None: ("lanes", "sim_jax", "tuner", "examples", "docs"),
    "test": ("tests",),
    "bench": ("benchmarks",),
    "cluster": ("tuner/engine", STORE),
    "service": ("tuner/service", STORE),
    "postgresql": (),
    "matlab": ("tuner/recordings/matlab.py",),
    "simulators": tuple(f"{TARGETS}/{name}.py" for name in ("mujoco", "drone_models", "rotorpy")),
}
#: What lies inside other folders and is asked of an extra alone.
APART = {
    ROOT / place for name in ("cluster", "service", "matlab", "simulators") for place in USES[name]
}


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def declared(extra: str | None, *, others: bool = False) -> set[str]:
    """Return what an extra brings, with what the ``others`` that it names bring."""
    requirements = (
        PROJECT["dependencies"] if extra is None else PROJECT["optional-dependencies"][extra]
    )
    found = set()
    for line in requirements:
        if own := re.fullmatch(re.escape(PROJECT["name"]) + r"\[(.*)\]", line):
            for other in own[1].split(",") if others else ():
                found |= declared(other)
        else:
            found.add(normalised(re.match(r"[\w.-]+", line)[0]))
    return found


def modules(tree: ast.AST, *, by_name: bool = True) -> Iterator[str]:
    """Yield the modules that a file imports, those named to `importlib` and `importorskip` too.

    Tests name to `importlib` what they have written themselves, so that there it does not count.
    """
    functions = {"importorskip", "import_module"} if by_name else {"importorskip"}
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module=str(module), level=0):
                yield module
            case ast.Call(
                func=ast.Attribute(attr=function), args=[ast.Constant(value=str(module)), *_]
            ) if function in functions:
                yield module


@cache
def imported(*folders: str) -> set[str]:
    packages = {
        module.split(".")[0]
        for folder in folders
        for path in ([ROOT / folder] if folder.endswith(".py") else (ROOT / folder).rglob("*.py"))
        if ROOT / folder in APART or not APART & {path, *path.parents}
        for module in modules(
            ast.parse(path.read_text(encoding="utf-8")), by_name=folder != "tests"
        )
    }
    outside = packages - sys.stdlib_module_names - OURS - {"compression"}  # of Python 3.14
    return {normalised(DISTRIBUTIONS.get(package, package)) for package in outside}


@pytest.mark.parametrize("extra", USES, ids=str)
def test_everything_imported_is_declared(extra):
    known = declared(None) | declared(extra, others=True) | WHERE_INSTALLED.get(extra, set())
    assert imported(*USES[extra]) <= known


@pytest.mark.parametrize("extra", USES, ids=str)
def test_everything_declared_is_imported(extra):
    assert declared(extra) - NOT_IMPORTED <= imported(*USES[extra])


def test_no_extra_but_the_tools_goes_unchecked():
    assert set(PROJECT["optional-dependencies"]) - set(USES) == TOOLS
    assert set.union(*map(declared, TOOLS)) <= NOT_IMPORTED


def test_an_import_is_seen_however_it_is_written():
    source = "import a.b\nfrom c import d\nfrom . import e\nimportlib.import_module('f.g')"
    assert set(modules(ast.parse(source))) == {"a.b", "c", "f.g"}
