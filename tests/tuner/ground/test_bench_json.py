import re
from pathlib import Path

import tuner.ground
import tuner.inertial
from tuner.ground.measurement import (
    REMARKS,
    ExperimentRecord,
    Remark,
    numbers_in_words,
    remarks_in_words,
)


def test_every_remark_has_a_sentence():
    folders = [Path(package.__file__).parent for package in (tuner.ground, tuner.inertial)]
    sources = [path for folder in folders for path in folder.glob("*.py")]
    codes = {code for path in sources for code in re.findall(r'Remark\("(\w+)"', path.read_text())}
    assert codes == set(REMARKS)


def experiment(*remarks, rows=({"motor_constant": 1.0},), value=(-11.0,), std_error=(0.01,)):
    return ExperimentRecord(
        name="thrust_stand",
        rows=list(rows),
        value=list(value),
        std_error=list(std_error),
        remarks=[Remark(code, numbers) for code, numbers in remarks],
        curves=[],
    )


def test_numbers_stand_in_the_sentences():
    given = experiment(("levels", {"levels": 9, "outliers": 3}), ("offset", {"force": 0.4}))
    first, second = remarks_in_words(given)
    assert first == "9 steady levels; 3 samples of the tachometer were dropped."
    assert second == "The sensor reads +0.40 N at rest."


def test_a_relation_is_told_from_a_value():
    rows = [
        {"motor_constant": 1.0},
        {"moment_constant": 1.0, "motor_constant": 1.0},
        {"rotor_drag_coefficient": 1.0, "moment_constant": -1.0},
    ]
    words = numbers_in_words(
        experiment(rows=rows, value=(-11.0, -14.0, 5.0), std_error=(0.01, 0.02, 0.1))
    )
    assert words[0] == "motor_constant 1.6702e-05 ± 1.7e-07 N s²/rad²"
    assert words[1].startswith("moment_constant · motor_constant 8.3153e-07")
    assert words[2] == "a relation of rotor_drag_coefficient and moment_constant to ±20 %"
