"""Every command with its options, from the command line's own parser."""

from __future__ import annotations

from inspect import Parameter
from typing import Any

from cyclopts import App

from docs.generate.text import GENERATED, cell, type_in_words
from tuner.cli.app import COMMANDS, EXAMPLES, SUMMARY, app

INTRO = """# Commands

`tune` is the job; the other commands look at recordings and results. Exit status: 0 done, 2 the
input is wrong (one line says where, what and what to do: [Messages](messages.md)), 1 a fault of
ours. `tune COMMAND --help` prints what stands here.
"""


def commands_page() -> str:
    """Return the page."""
    parts = [f"{GENERATED}{INTRO}", _section("tune", app, SUMMARY, EXAMPLES)]
    for name, (summary, *examples) in COMMANDS.items():
        parts.append(_section(f"tune {name}", app[name], summary, examples))
        parts += _under(f"tune {name}", app[name])
    return "\n".join(parts)


def _under(title: str, command: App) -> list[str]:
    """Return a section of each command below another one."""
    sections = []
    for name in command:
        if not name.startswith("-"):
            inner = command[name]
            if inner.default_command is not None:
                sections.append(
                    _section(f"{title} {name}", inner, inner.help.partition("\n\n")[0], ())
                )
            sections += _under(f"{title} {name}", inner)
    return sections


def _section(title: str, command: App, summary: str, examples: Any) -> str:
    rows = [
        f"| {_names(argument)} | {cell(_help(argument))} | {_default(argument)} |"
        for argument in command.assemble_argument_collection(parse_docstring=True)
        if argument.show
    ]
    usage = "```sh\n" + "\n".join(examples) + "\n```\n\n" if examples else ""
    table = "\n".join(["| option | meaning | default |", "| --- | --- | --- |", *rows])
    return f"## {title}\n\n{summary}\n\n{usage}{table}\n"


def _names(argument: Any) -> str:
    return f"`{argument.names[0] if argument.names else argument.name}`"


def _help(argument: Any) -> str:
    choices = type_in_words(argument.hint)
    said = argument.parameter.help or ""
    return f"{said} One of {choices}." if choices.startswith("`") else said


def _default(argument: Any) -> str:
    default = argument.field_info.default
    if default in (None, False, ""):
        return ""
    if default is Parameter.empty:
        return "required" if argument.required else type_in_words(argument.hint)
    return f"`{default}`"
