"""Every line with which `tune` refuses an input, and every finding of a run, each with an anchor.

The lines are read from the source: the text of each error that it raises, with … where a value
stands.
"""

from __future__ import annotations

import ast
import re
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

from docs.generate.text import GENERATED
from tuner import __file__ as _package
from tuner.findings.findings import Code

PACKAGE = Path(_package).parent
UNKNOWN = "…"

#: Where a message comes from -> stage in which a user meets it; the first that matches.
TOPICS: Mapping[str, str] = {
    "service/": "The tuning service",
    "recording": "Reading recordings",
    "job_flights": "Reading recordings",
    "ground/": "Ground measurements",
    "exporters/": "Export",
    "vehicle/": "Vehicle, controller and job files",
    "config": "Vehicle, controller and job files",
    "core/yaml": "Vehicle, controller and job files",
    "core/shipped": "Vehicle, controller and job files",
    "evaluate/": "Simulating and comparing",
    "objective/trajectory": "Simulating and comparing",
    "engine/": "Workers and clusters",
    "cli/": "The command line",
    "core/": "Files and folders",
    "": "Searching, and its result",
}
ORDER = (
    "The command line",
    "Vehicle, controller and job files",
    "Reading recordings",
    "Ground measurements",
    "Searching, and its result",
    "Simulating and comparing",
    "Export",
    "Files and folders",
    "Workers and clusters",
    "The tuning service",
)

#: Stage of a run -> beginnings of the codes of what is found there; the first that matches.
STAGES: Mapping[str, tuple[str, ...]] = {
    "While recordings are read": (
        *("recording", "salvaged", "left_out", "missing_signals", "pose_gap", "sparse_input"),
        *("manoeuvres", "px4_loops", "logged_gains", "logs_differ", "inlet_chosen", "motor_order"),
        *("attitude_followed", "spins_reversed", "rotor_changed"),
    ),
    "Before the search": (
        *(
            "same_recording",
            "vehicle_not",
            "mass_not",
            "wrong_vehicle",
            "cannot_hover",
            "rotors_stop",
        ),
        "lifts_otherwise",
        *("still_axes", "no_yaw", "implausible", "start_on_bound"),
        *("not_finite", "nothing_has", "no_effect", "singular", "setpoints", "heading_flown"),
        *("rate_loop", "input_late", "turning_regressed", "turning_not"),
    ),
    "Without a pose": ("scales_with", "no_tacho", "yaw_open", "rate_"),
    "Of ground measurements": ("ground_conflict", "bench_conflict"),
    "After the search": ("",),
}
NOTHING_TO_DO = "Nothing to do."

INTRO = """# Messages

What `tune` says when an input cannot be used, and what it says of a run before you believe a
number. … stands for a file, an option, a name or a number. A refusal is one line,
`where: what; remedy`, exit status 2, and nothing was overwritten. For what to look at when no
message appears, see [Troubleshooting](../how-to/troubleshooting.md).
"""

#: Findings whose sentences have parts that come and go.
IN_OTHER_WORDS: Mapping[Code, str] = {
    Code.RECORDING: "Reading the recording raised a doubt, which the line states.",
    Code.LEFT_OUT: "The recording cannot be read, nothing flies in it, it contradicts itself, or "
    "the flight lacks what its inlet needs: it is left out; the line says why and what to do.",
    Code.SALVAGED: "The recording is broken, and the flight is what was salvaged of it; the line "
    "states what was lost. Record the flight again if that matters.",
    Code.LIFTS_OTHERWISE: "In hover, rotors lift more or less of the weight at the same commands "
    "(or speeds) than in the other flights: battery, payload, propellers or the whole vehicle are "
    "others. Fit flights of one vehicle and payload, each kind by itself.",
    Code.GROUND_CONFLICT: "Ground measurements and flights disagree, model error included. What "
    "flights show over the mass alone names the mass at which they would agree: weigh the vehicle "
    "again. Else find out which is wrong, the rig or the model.",
    Code.SATURATION_FEEDBACK: "Rotors were clipped at their lower limit, and the recordings agree "
    "with a mixer that desaturates and a rate integrator that stops then, as PX4's do, or with "
    "neither, other than the controller file has it; it was simulated so. Set "
    "mixer.saturation_feedback in the controller file.",
    Code.SEES_MARKERS: "The markers' frame is off the vehicle's, and the recordings agree with "
    "position and attitude controllers that see that frame, or with controllers that see the "
    "centre of mass and the body's axes, other than the controller file has it; it was simulated "
    "so. Set sensing.sees_markers in the controller file.",
    Code.FLIGHT_NOT_FLOWN: "The fitted model does not fly this flight although it flies others; "
    "the line says from when on, and whether the simulated position control is beyond its limit.",
    Code.LAW_LACKING: "Recorded accelerations hold a force or moment that the model does not; the "
    "line says along which axis, what it goes with, which coefficients it may have moved, whose "
    "intervals hold that, and which terms are of that kind.",
    Code.CONTROLLER_ANSWERS: "Recorded commands follow from rate set-points and gyro with another "
    "P or I than the controller file's, or later or earlier than its filters and D let them. "
    "Compare it with the autopilot's parameters, and the vehicle file's arms with the vehicle's; "
    "intervals hold what the difference moves. Where one flight alone has another P, the line "
    "names it: leave it out.",
    Code.RATE_LOOP_DIFFERS: "Before the search the controller file's rate loop is replayed on the "
    "recorded rate set-points and body rates: the recorded commands follow from other gains, "
    "filters or another rate of it, which the line names with their values. Correct the controller "
    "file by the autopilot's parameters. Where no term of the fit stands for what differs, the run "
    "calls itself not usable.",
    Code.ROTOR_SPEEDS_LATE: "Recorded rotor speeds come after the turning that they make, or "
    "before it: they were filtered, or are stamped otherwise than the gyro. Intervals hold what "
    "that moves.",
    Code.TERM_SHOWS: "A term that was found says something of the vehicle or its files: thrust "
    "grows with another power of the rotor speed than the second, motors have a second lag, gains "
    "or filters are not those of the controller file, the autopilot sits askew, its gyro's scale "
    "is off, or rotor speeds were filtered. The line says by how much, what to compare, and which "
    "other term the flights do not tell from it.",
    Code.ROTORS_STOP: "Recorded rotors stop at some speed whatever more is commanded, and the "
    "vehicle file has them stop at another. Set motor.max_rotor_velocity there.",
    Code.ROTORS_UNEQUAL: "Rotors would differ in thrust at the same speed by 9 % and more, which "
    "rotors of a kind do not. A vehicle file with the rotors elsewhere than they sit makes them "
    "seem so, and forces and inertia are wrong with it. Measure where they sit, and look at the "
    "propellers.",
    Code.ROTOR_CHANGED: "From some time of this flight a rotor gives less, or more, thrust at the "
    "same speed than before: the flight is used up to there. Look at its propeller, motor and "
    "mount before you fly again.",
    Code.INLET_CHOSEN: "What was logged does not explain how the vehicle turned, so that its "
    "recorded attitude is followed, or it is simulated from its rotor speeds. Log commands as "
    "often as the rate loop runs.",
    Code.SETPOINTS_SCALED: "The recorded set-points of rates, or of thrust, are a multiple of the "
    "controller file's. Check its gains, its attitude.law, or its map from acceleration to thrust.",
    Code.SETPOINTS_BIASED: "Recorded rate set-points are off the controller file's by a constant, "
    "as where the recorded attitude is tilted against the one that was controlled. Check how the "
    "motion capture's rigid body is aligned with the vehicle (marker_tilt).",
    Code.SETPOINTS_FOREIGN: "Another controller flew, or another reference: the recorded rate "
    "set-points do not follow from reference, state and controller file. Give the controller that "
    "flew (--controller), or enter below it (inlet: body_rate).",
    Code.HOLDING_BETTER: "Holding what was recorded of this flight's state, all of it or what the "
    "line names, predicts it better than the fitted coefficients do, by more than chance. Predict "
    "less far ahead, or with more recorded.",
    Code.DISTURBANCES_FOLLOWED: "The residuals hold more than noise, as gusts leave it, and a "
    "Kalman filter estimates the disturbances. Nothing to do.",
    Code.FLIGHTS_DISAGREE: "Some flights call for another value of a coefficient than the others, "
    "by more than chance; the line says which and by how much. Fit them by themselves: their "
    "vehicle, payload, propellers, battery or gains may differ.",
    Code.FLIGHT_UNMATCHED: "The simulation does not match this flight, and its weight in the fit "
    "was lowered accordingly. Leave it out: its vehicle, payload, controller, clock or wind may be "
    "others.",
}

FINDINGS = """## Findings of a run

They stand on the terminal, at the top of the page and, as codes with numbers, in `result.json`
(`findings`). A `failure` stops the run unless `--force`, a `warning` does not, an `info` explains.
"""


@dataclass(frozen=True)
class Message:
    """One line's fixed words: what is wrong, and what to do."""

    topic: str
    what: str
    remedy: str

    @property
    def anchor(self) -> str:
        """The heading's address, of letters and digits alone."""
        return re.sub(r"[^a-z0-9]+", "-", self.what.lower().replace(UNKNOWN, " ")).strip("-")


COMPLAINTS = tuple(
    Message("Vehicle, controller and job files", what, remedy)
    for what, remedy in (
        (f"unknown key '{UNKNOWN}'", f"did you mean {UNKNOWN}?"),
        (f"key '{UNKNOWN}' is missing", "add it"),
        (f"{UNKNOWN} is {UNKNOWN}", f"it should be {UNKNOWN}, as a number, or more than 0"),
    )
)
"""On a key of a file or a request: `tuner.core.yaml_section.complaint` words them, no error."""


def messages_page() -> str:
    """Return the page."""
    parts = [f"{GENERATED}{INTRO}"]
    messages = known_messages()
    seen: set[str] = set()
    for topic in ORDER:
        parts.append(f"## {topic}\n")
        for message in sorted((m for m in messages if m.topic == topic), key=lambda m: m.anchor):
            anchor = "" if message.anchor in seen else f'<a id="{message.anchor}"></a>'
            seen.add(message.anchor)
            parts.append(f"- {anchor}**{_shown(message.what)}**; {_shown(message.remedy)}")
        parts.append("")
    parts.append(FINDINGS)
    stage_of = {code: _stage(code) for code in Code}
    for stage in STAGES:
        parts.append(f"\n### {stage}\n")
        parts += [_finding(code) for code in Code if stage_of[code] == stage]
    return "\n".join(parts) + "\n"


def _stage(code: Code) -> str:
    return next(s for s, begins in STAGES.items() if code.value.startswith(begins))


def _finding(code: Code) -> str:
    line = IN_OTHER_WORDS.get(code) or f"{code.text} {code.remedy or NOTHING_TO_DO}"
    line = _shown(re.sub(r"\{[^}]*\}", UNKNOWN, line))
    return f'- <a id="{code}"></a>`{code}`: {line}'


def _shown(text: str) -> str:
    return re.sub(r"([<>*_|])", r"\\\1", text)


def known_messages() -> list[Message]:
    """Return the messages of all errors whose words stand in the source, each once."""
    found = dict.fromkeys([*COMPLAINTS, *(m for _, messages in sites() for m in messages)])
    anchors: dict[tuple[str, str], Message] = {}
    for message in found:
        anchors.setdefault((message.what, message.remedy), message)
    return list(anchors.values())


@cache
def sites() -> tuple[tuple[str, list[Message]], ...]:
    """Return where each error is raised, as ``file:line``, and the messages that it may have."""
    return tuple(_sites())


def _sites() -> Iterator[tuple[str, list[Message]]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        topic = next(title for part, title in TOPICS.items() if part in place)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for scope in ast.walk(tree):
            if isinstance(scope, ast.FunctionDef):
                for call in _errors_made(scope):
                    what, remedy = call.args[-2:]
                    wordings = _pairs(what, remedy, scope)
                    messages = [Message(topic, a, b) for a, b in wordings if _says_something(a)]
                    yield f"{place}:{call.lineno}", messages


def _errors_made(scope: ast.FunctionDef) -> Iterator[ast.Call]:
    """Yield the calls that make an error, those of functions within left to these."""
    left: deque[ast.AST] = deque([scope])
    while left:
        node = left.popleft()
        left += (n for n in ast.iter_child_nodes(node) if not isinstance(n, ast.FunctionDef))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            ours = node.func.id.endswith("Error") and not node.func.id.startswith("Pydantic")
            made = ours and len(node.args) == 3
            refused = node.func.id == "refuse" and len(node.args) == 2
            if made or refused:
                yield node


def _wordings(node: ast.expr, scope: ast.FunctionDef) -> list[str]:
    """Return the texts that an expression may have, … where they are not known."""
    texts = [UNKNOWN]
    match node:
        case ast.Constant(value=str(text)):
            texts = [text]
        case ast.JoinedStr(values=parts):
            pieces = [_wordings(part, scope) for part in parts]
            texts = ["".join(words) for words in product(*pieces)]
        case ast.BinOp(op=ast.Add(), left=left, right=right):
            texts = [a + b for a in _wordings(left, scope) for b in _wordings(right, scope)]
        case ast.IfExp(body=body, orelse=orelse):
            texts = _wordings(body, scope) + _wordings(orelse, scope)
        case ast.Call(func=ast.Name(id="did_you_mean")):
            texts = ["did you mean …?"]
        case ast.Name():
            texts = _assigned(node, scope) or texts
        case ast.FormattedValue(value=ast.Name() as name, format_spec=None):
            texts = list(filter(_says_something, _assigned(name, scope))) or texts
    return texts


def _pairs(what: ast.expr, remedy: ast.expr, scope: ast.FunctionDef) -> Iterable[tuple[str, str]]:
    """Return what is wrong with what to do: side by side where both are assigned together."""
    texts, remedies = _wordings(what, scope), _wordings(remedy, scope)
    if len(texts) == len(remedies) > 1:
        return zip(texts, remedies, strict=True)
    return product(texts, remedies)


Blocks = tuple[int, ...]


def _assigned(name: ast.Name, scope: ast.FunctionDef) -> list[str]:
    """Return the texts that a name may have where it stands in a function.

    They are those of the last assignment before it that is always made, and of the later ones in
    branches that do not leave the function.
    """
    made = [found for found in _assignments(name.id, scope.body, ()) if found[0] < name.lineno]
    here = _blocks_of(name.lineno, scope.body, ())
    texts: list[str] = []
    for _, value, blocks, leaves in reversed(made):
        always = here[: len(blocks)] == blocks
        itself = any(isinstance(n, ast.Name) and n.id == name.id for n in ast.walk(value))
        if (always or not leaves) and not itself:
            texts = _wordings(value, scope) + texts
        if always and not itself:
            break
    return texts


def _inner(statement: ast.stmt) -> Iterator[list[ast.stmt]]:
    """Yield the blocks of a statement; a function within has names of its own."""
    if isinstance(statement, ast.FunctionDef):
        return
    for part in (statement, *getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
        for field in ("body", "orelse", "finalbody"):
            if block := getattr(part, field, None):
                yield block


def _assignments(
    name: str, block: list[ast.stmt], blocks: Blocks
) -> Iterator[tuple[int, ast.expr, Blocks, bool]]:
    """Yield line, value and blocks of each assignment, and whether its block leaves."""
    leaves = isinstance(block[-1], ast.Raise | ast.Return | ast.Continue | ast.Break)
    for statement in block:
        if isinstance(statement, ast.Assign):
            for target in statement.targets:
                pairs = [(target, statement.value)]
                if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
                    pairs = list(zip(target.elts, statement.value.elts, strict=False))
                for to, value in pairs:
                    if isinstance(to, ast.Name) and to.id == name:
                        yield statement.end_lineno or 0, value, blocks, leaves
        for inner in _inner(statement):
            yield from _assignments(name, inner, (*blocks, id(inner)))


def _blocks_of(line: int, block: list[ast.stmt], blocks: Blocks) -> Blocks:
    """Return the blocks within which a line stands, the outermost first."""
    for statement in block:
        for inner in _inner(statement):
            if inner[0].lineno <= line <= (inner[-1].end_lineno or 0):
                return _blocks_of(line, inner, (*blocks, id(inner)))
    return blocks


def _says_something(text: str) -> bool:
    return len(re.sub(r"[^a-z]", "", text.lower())) >= 4
