"""The documents as the tests read them: their text, commands, links and anchors."""

from __future__ import annotations

import re
import shlex
from enum import Enum
from functools import cache
from pathlib import Path

from cyclopts.exceptions import CycloptsError, MissingArgumentError

from tuner.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
HELP = [ROOT / "tuner" / "cli" / name for name in ("app.py", "serve.py")]
"""What ``--help`` shows examples of."""
WITH_COMMENTS = [
    *(ROOT / "deploy" / name for name in ("Dockerfile", "tune.service")),
    *sorted((ROOT / "configs").rglob("*.yaml")),
    ROOT / "examples" / "bench" / "bench.yaml",
]
"""Files of which a comment says by which command they are used."""
WITH_COMMANDS = [*PAGES, *HELP, *WITH_COMMENTS]

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")
_IMAGE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the code blocks of a page in some languages."""
    found = _BLOCK.findall(page.read_text(encoding="utf-8"))
    return [text for language, text in found if language in languages]


class Family(Enum):
    """What runs a command, one test module each."""

    TUNE = "test_commands.py"
    SERVICE = "test_service_commands.py"
    SET_UP = "test_setting_up.py"


PROGRAMS = {"tune": Family.TUNE} | dict.fromkeys(
    ("cp", "docker", "git", "make", "pip", "pytest", "python", "python3", "sudo"), Family.SET_UP
)
TO_A_SERVER = ("cancel", "fetch", "jobs", "serve", "submit", "watch", "watch-folder")


def commands(page: Path, *families: Family) -> list[str]:
    """Return what a page asks its reader to type: in its blocks, then what is whole in its text."""
    text = page.read_text(encoding="utf-8")
    if page in HELP:
        found = re.findall(r'^ +"(tune [^"]+)",$', text, re.MULTILINE)
    elif page in WITH_COMMENTS:
        comments = re.findall(r"^#(?:   |.*: )(\S.*)$", text, re.MULTILINE)
        found = [line for line in comments if line.split()[0] in PROGRAMS]
    else:
        lines = [line for block in blocks(page, "", "sh") for line in block.splitlines()]
        spans = [span for span in in_the_text(page) if is_whole(span)]
        found = [line for line in (*lines, *spans) if not line.startswith("#")]
    typed = [re.split(r"\s+#|\s{3,}", line.strip())[0] for line in found]
    return [line for line in dict.fromkeys(typed) if line and family(line) in (families or Family)]


def in_the_text(page: Path) -> list[str]:
    """Return what stands in a page's text as code and begins as a command does."""
    spans = re.findall(r"`([^`\n]+)`", _BLOCK.sub("", page.read_text(encoding="utf-8")))
    return [
        span
        for span in spans
        if " " in span and words_of(span)[:1] and words_of(span)[0] in PROGRAMS
    ]


@cache
def is_whole(span: str) -> bool:
    """Return whether a command in the text can be typed as it stands there."""
    words = words_of(span)
    if words[0] != "tune" or "--help" in words:
        return True
    if len(words) < 3 or "…" in words:
        return False
    try:
        app.parse_args(words[1:], exit_on_error=False, print_error=False)
    except MissingArgumentError:
        return False
    except CycloptsError:
        pass  # whoever runs it will see
    return True


def family(line: str) -> Family:
    """Return what runs a command."""
    words = words_of(line)
    return Family.SERVICE if words[0] == "tune" and words[1] in TO_A_SERVER else PROGRAMS[words[0]]


def words_of(line: str) -> list[str]:
    """Return a command's words, without the variables that are set before them."""
    return shlex.split(re.sub(r"^(?:[A-Z_]+=(?:\$\([^)]*\)|\S)+ )+", "", line))


def expanded(line: str) -> list[str]:
    """Return the arguments of a ``tune`` command, patterns expanded as a shell does."""
    words = []
    for word in shlex.split(line)[1:]:
        found = sorted(map(str, Path().glob(word))) if "*" in word else []
        words += found if found and f"'{word}'" not in line else [word]
    return words


def prose(page: Path) -> str:
    """Return a page's text without code."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    return re.sub(r"`[^`\n]*`", "`code`", text)


def links(page: Path) -> list[str]:
    text = prose(page)
    return [*_LINK.findall(text), *_IMAGE.findall(text)]


def figures(page: Path) -> list[str]:
    """Return the names of the pictures of a page that a command has drawn."""
    return [Path(link).name for link in _IMAGE.findall(prose(page)) if link.endswith(".svg")]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page: those of its headings, and those that it sets itself."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    headings = {
        re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())
        for heading in _HEADING.findall(text)
    }
    return headings | set(re.findall(r'<a id="([^"]+)">', text))
