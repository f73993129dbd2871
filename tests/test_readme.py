"""What a user types after the documents is what the program takes."""

import ast
import inspect
import re
import shlex
from pathlib import Path

import pytest

from tuner import api
from tuner.cli.app import app

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def commands():
    """Return every `tune …` line of the README's code blocks and of the Makefile."""
    blocks = re.findall(r"```(?:\w*)\n(.*?)```", README, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += (ROOT / "Makefile").read_text(encoding="utf-8").replace("$(BIN)/", "").splitlines()
    commands = [line.strip() for line in lines if re.match(r"\s*(\$ )?tune\b", line)]
    return [line.removeprefix("$ ") for line in commands]


def test_the_documents_show_commands():
    assert len(commands()) >= 6


@pytest.mark.parametrize("line", commands())
def test_a_command_of_the_documents_is_understood(line):
    words = shlex.split(line.replace("[", "").replace("]", ""), comments=True)
    command, bound, _ = app.parse_args(words[1:], exit_on_error=False, print_error=False)
    assert callable(command)
    assert bound.arguments


def test_the_python_of_the_readme_calls_what_there_is():
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    calls = [
        node
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == "tuner"
    ]
    assert {call.func.attr for call in calls} >= {
        "load_flight",
        "fit",
        "compare",
        "sensitivity",
        "simulate",
        "export",
    }
    for call in calls:
        signature = inspect.signature(getattr(api, call.func.attr))
        signature.bind(*call.args, **{keyword.arg: keyword.value for keyword in call.keywords})
