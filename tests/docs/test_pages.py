"""What the documents say is what there is: commands, links, generated pages, messages."""

from __future__ import annotations

import json
import re
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.__main__ import BY_NAME, PARTS
from docs.generate.house import house_page, rooms
from docs.generate.messages import IN_OTHER_WORDS, ORDER, STAGES, TOPICS, known_messages, sites
from docs.generate.pages import OPENAPI, REFERENCE, SCHEMA
from docs.generate.pages import PAGES as GENERATED
from tests.docs.pages import PAGES, ROOT, anchors, blocks, links, name_of
from tuner.config import read_job
from tuner.engine.engine import read_cluster
from tuner.findings.findings import Code
from tuner.ground.plan import read_bench
from tuner.recordings.topics import load_topic_map, read_sidecar
from tuner.result import RunResult
from tuner.vehicle import read_controller, read_vehicle

READERS = {
    "bench-file.md": (read_bench,),
    "cluster-file.md": (lambda path: read_cluster(str(path)),),
    "controller-file.md": (read_controller,),
    "job-file.md": (read_job,),
    "topic-maps.md": (load_topic_map, read_sidecar),
    "vehicle-file.md": (read_vehicle,),
}
"""Page -> what reads its YAML, in the order in which it stands there."""
PROGRAM = re.compile(
    r"`(?:python -m ((?:benchmarks|docs|tests|tuner)[\w.]*)|python (examples/\w+\.py)"
    r"|pytest (tests/[\w/.]+))([^`]*)`"
)


@pytest.mark.parametrize("name", sorted(set(GENERATED) - {OPENAPI}))
def test_a_generated_page_is_what_the_code_says(name):
    written = (REFERENCE / name).read_text(encoding="utf-8")
    assert written == GENERATED[name](), "run `python -m docs.generate`"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path):
    for link in links(page):
        if link.startswith("https://"):
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT)
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_are_named_exist(page: Path):
    named = re.findall(
        r"`((?:tuner|sim_jax|tests|configs|examples|benchmarks|docs|reference_flights)/[\w./-]*)`",
        page.read_text(encoding="utf-8"),
    )
    assert [path for path in named if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "yaml")], ids=name_of)
def test_yaml_that_is_shown_is_read(page: Path, tmp_path: Path):
    readers = READERS.get(page.name, ())
    for text, read in zip(blocks(page, "yaml"), readers, strict=True):
        shown = tmp_path / "shown.yaml"
        shown.write_text(text, encoding="utf-8")
        read(shown)


def test_programs_that_are_named_exist():
    named = [found for page in PAGES for found in PROGRAM.findall(page.read_text("utf-8"))]
    assert len(named) > 10
    for module, example, test, arguments in named:
        if module:
            assert find_spec(module), module
            assert module != "benchmarks" or set(arguments.split()) <= {*PARTS, *BY_NAME}, arguments
        else:
            assert (ROOT / (example or test)).exists(), example or test


def test_the_house_is_drawn_from_the_imports():
    written = (ROOT / "docs/project/house.md").read_text(encoding="utf-8")
    assert written == house_page(), "run `python -m docs.generate`"


def test_the_house_has_every_room():
    packages = {f"tuner.{path.parent.name}" for path in (ROOT / "tuner").glob("*/__init__.py")}
    assert packages <= set(rooms())


def test_every_error_line_has_one_anchor():
    page = (REFERENCE / "messages.md").read_text(encoding="utf-8")
    counts = Counter(re.findall(r'<a id="([^"]+)">', page))
    assert set(counts.values()) == {1}
    assert {message.anchor for message in known_messages()} <= set(counts)
    assert set(Code) <= set(counts)


def test_messages_are_grouped_by_stage_and_have_an_answer():
    page = (REFERENCE / "messages.md").read_text(encoding="utf-8")
    assert set(ORDER) == set(TOPICS.values())
    places = [page.index(f"## {stage}\n") for stage in (*ORDER, "Findings of a run")]
    assert places == sorted(places)
    groups = page.partition("## Findings of a run")[2].split("\n### ")[1:]
    assert [group.partition("\n")[0] for group in groups] == list(STAGES)
    assert all(group.count("<a id=") > 1 for group in groups)
    assert set(IN_OTHER_WORDS) >= {c for c in Code if not isinstance(c.text, str)}
    refusals = re.findall(r"^- (?:<a id=.*?</a>)?\*\*.*\*\*; (.*)$", page, flags=re.MULTILINE)
    assert len(refusals) > 300
    assert all(refusals)


def test_a_message_has_the_remedy_that_goes_with_it():
    remedies: dict[str, list[str]] = {}
    for message in known_messages():
        remedies.setdefault(message.what, []).append(message.remedy)
    assert remedies["swings by … degrees"] == [
        "release it within 20 degrees, the law is for small angles"
    ]
    assert remedies["shows … oscillations, fewer than …"] == ["let it swing longer"]


def test_the_words_of_nearly_every_error_are_known():
    unknown = [place for place, messages in sites() if not messages]
    assert len(sites()) > 150
    assert len(unknown) < 0.1 * len(sites()), unknown


def test_the_description_of_the_service_has_every_call():
    written = json.loads((REFERENCE / OPENAPI).read_text(encoding="utf-8"))
    described = json.loads(GENERATED[OPENAPI]())  # whose details follow from FastAPI's version
    assert {path: set(calls) for path, calls in written["paths"].items()} == {
        path: set(calls) for path, calls in described["paths"].items()
    }
    assert set(written["components"]["schemas"]) == set(described["components"]["schemas"])


def test_the_schema_of_the_result_knows_every_field():
    schema = json.loads((REFERENCE / SCHEMA).read_text(encoding="utf-8"))
    assert set(schema["properties"]) == set(RunResult.model_fields)
    assert (
        schema["properties"]["schema_version"]["default"]
        == RunResult.model_fields["schema_version"].default
    )
