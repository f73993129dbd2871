"""The calls of the tuning service, from its own description."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from docs.generate.text import GENERATED, cell
from tuner.service.app import create_app
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

INTRO = """# HTTP interface

What `tune serve` answers, under `/api/v1`; its description as OpenAPI stands in
[openapi.json](openapi.json), and at `/api/v1/openapi.json` of a server. A refusal is JSON with
`where`, `what`, `remedy` and the whole line as `detail`. Where tokens are demanded, send
`Authorization: Bearer TOKEN`.
"""


@cache
def description() -> dict[str, Any]:
    """Return the service as OpenAPI, without the version that happens to be installed."""
    with tempfile.TemporaryDirectory() as folder:
        service = Service.open(ServiceSettings(Path(folder) / "data", workers=0))
        try:
            described = create_app(service).openapi()
        finally:
            service.close()
    described["info"]["version"] = "1"
    return described


def openapi_file() -> str:
    """Return the description as a file."""
    return json.dumps(description(), indent=1, ensure_ascii=False) + "\n"


def http_page() -> str:
    """Return the page: each call, and the fields of what goes in and comes out."""
    calls = [
        f"| `{method.upper()} {path}` | {cell(call.get('description', ''))} | {_statuses(call)} |"
        for path, methods in description()["paths"].items()
        for method, call in methods.items()
    ]
    table = "\n".join(["| call | what it does | answers |", "| --- | --- | --- |", *calls])
    shapes = [
        f"- `{name}`: {', '.join(f'`{field}`' for field in shape['properties'])}"
        for name, shape in description()["components"]["schemas"].items()
        if "properties" in shape
    ]
    return f"{GENERATED}{INTRO}\n{table}\n\n## Shapes\n\n" + "\n".join(shapes) + "\n"


def _statuses(call: dict[str, Any]) -> str:
    return " ".join(sorted(call["responses"]))
