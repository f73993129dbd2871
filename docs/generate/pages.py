"""Each generated page of the reference: its name, and the function that gives its text."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from docs.generate.commands import commands_page
from docs.generate.http import http_page, openapi_file
from docs.generate.messages import messages_page
from docs.generate.models import sections_of
from docs.generate.text import GENERATED
from tuner.config import JobFile
from tuner.core.shipped import configs_folder
from tuner.engine.engine import ClusterFile
from tuner.ground.plan import BenchFile
from tuner.result import RunResult
from tuner.vehicle import COEFFICIENTS, Coefficient, ControllerFile, ExportTag, VehicleFile

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"
SCHEMA = "result.schema.json"
OPENAPI = "openapi.json"


def _files_page(title: str, intro: str, model: type, example: Path) -> str:
    shown = f"```yaml\n{example.read_text(encoding='utf-8')}```"
    return f"{GENERATED}# {title}\n\n{intro}\n\n{shown}\n\n{sections_of(model)}"


def _vehicle() -> str:
    return _files_page(
        "Vehicle file",
        "The coefficients of one multirotor, under the names that Gazebo users know; "
        "[Coefficients](coefficients.md) has unit, meaning and source of each. `best_fit.yaml` of "
        "a result folder is one. This is the HoverGames quad with the thesis's coefficients, "
        "`--vehicle hovergames_updated`:",
        VehicleFile,
        configs_folder() / "vehicles" / "hovergames_updated.yaml",
    )


def _controller() -> str:
    return _files_page(
        "Controller file",
        "Gains, laws, loop rates and filters that flew. What is left out has the value below, that "
        "of the HoverGames set-up, which is `--controller hovergames`:",
        ControllerFile,
        configs_folder() / "controllers" / "hovergames.yaml",
    )


def _job() -> str:
    return _files_page(
        "Job file",
        "`tune.yaml` beside the flights, or any file named with `--config`. Nothing in it is "
        "required; options on the command line win over it.",
        JobFile,
        configs_folder() / "tune.yaml",
    )


def _bench() -> str:
    return _files_page(
        "Bench file",
        "What was measured on the ground, for `tune bench`. Recordings are CSV or Parquet tables "
        "with the columns named below, or, for poses, hovers and spins, any recording that `tune` "
        "reads. This one lies in `examples/bench/`:",
        BenchFile,
        ROOT / "examples" / "bench" / "bench.yaml",
    )


def _cluster() -> str:
    return _files_page(
        "Cluster file",
        "Where workers come from, for `--cluster`: this machine, a batch system, Kubernetes, or a "
        "Dask scheduler that runs already (`tcp://HOST:8786` in place of a file). It needs the "
        "extra `[cluster]`. `--dry-run` prints the job script of a batch system and does nothing. "
        "For Slurm, `configs/clusters/slurm.yaml`; others lie beside it:",
        ClusterFile,
        configs_folder() / "clusters" / "slurm.yaml",
    )


def _topics() -> str:
    guide = (configs_folder() / "topics" / "README.md").read_text(encoding="utf-8")
    return f"{GENERATED}{guide}"


def _coefficients() -> str:
    return (
        f"{GENERATED}# Coefficients\n\nOne row each in `tuner/vehicle/registry.py`, from "
        "which the vehicle file's keys, the search, the verdicts and the exports follow. Those of "
        "the section `effects` are terms beyond Gazebo's motor model: left out, they do not act; "
        f"freed, they start at the value at which they vanish.\n\n{markdown_table()}"
    )


def _schema() -> str:
    schema = RunResult.model_json_schema(mode="serialization")
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return json.dumps(dialect | schema, indent=1, ensure_ascii=False) + "\n"


PAGES: Mapping[str, Callable[[], str]] = {
    "commands.md": commands_page,
    "coefficients.md": _coefficients,
    "vehicle-file.md": _vehicle,
    "controller-file.md": _controller,
    "job-file.md": _job,
    "bench-file.md": _bench,
    "cluster-file.md": _cluster,
    "topic-maps.md": _topics,
    "messages.md": messages_page,
    "http.md": http_page,
    SCHEMA: _schema,
    OPENAPI: openapi_file,
}


_HEADER = ("coefficient", "unit", "meaning", "vehicle file", "fitted", "SDF", "PX4", "source")


def markdown_table() -> str:
    """Return the coefficients of a vehicle file as a Markdown table, a row each."""
    rows = [_HEADER, ("---",) * len(_HEADER), *map(_cells, COEFFICIENTS.values())]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _cells(row: Coefficient) -> tuple[str, ...]:
    return (
        f"`{row.name}`",
        row.unit or "–",
        row.meaning.replace("|", "\\|"),
        f"`{'.'.join(part for part in row.place if part)}`",
        "by default" if row.free else "if freed",
        _entry(row, "sdf"),
        _entry(row, "px4"),
        row.source.replace("<", "`<").replace(">", ">`"),
    )


def _entry(row: Coefficient, target: str) -> str:
    entry = row.exported_as.get(target)
    return f"`{entry.tag}`" if isinstance(entry, ExportTag) else "–"
