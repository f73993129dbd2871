"""The documents as the tests read them: their text, commands, links and anchors."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))

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


def commands(page: Path) -> list[str]:
    """Return every `tune …` line of a page's blocks for a shell."""
    lines = (line.strip() for block in blocks(page, "", "sh") for line in block.splitlines())
    return [line for line in lines if re.match(r"tune\b", line)]


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
