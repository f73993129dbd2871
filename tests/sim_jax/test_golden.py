"""Every block against the numbers of the original code; fixtures in ``golden/``."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.golden_check.files import CHECKS, check_of, golden_files, read
from tests.golden_check.table import Table, deviation

FOLDER = Path(__file__).parent / "golden"
FILES = dict(golden_files(FOLDER))


@pytest.mark.parametrize("name", FILES)
def test_block_agrees_with_the_original(name: str) -> None:
    check = check_of(name)
    assert check is not None
    outcome = check(read(FILES[name]))
    assert outcome
    assert not [row for row in outcome if not row.passed]


def test_every_golden_file_has_a_fixture() -> None:
    assert set(CHECKS) <= set(FILES)


@pytest.mark.parametrize("column", ["lee_wy", "bres_thrust"])
def test_a_wrong_number_is_noticed(column: str) -> None:
    frame = read(FILES["geo_attcontrollers"]).frame.copy()
    frame.loc[3, column] += 1e-9
    check = check_of("geo_attcontrollers")
    assert check is not None
    assert any(not row.passed for row in check(Table(frame)))


def test_a_wrong_saturation_flag_is_noticed() -> None:
    whole = read(FILES["px4_mixer_quad_x"]).frame
    settings = whole[["airmode", "thrust_factor"]]
    frame = whole[(settings == settings.loc[0]).all(axis=1)].copy()
    frame.loc[0, "roll_pos"] = 1 - frame.loc[0, "roll_pos"]
    check = check_of("px4_mixer_quad_x")
    assert check is not None
    (wrong,) = (row for row in check(Table(frame)) if not row.passed)
    assert wrong.quantity == "saturation flags"


def test_not_a_number_never_passes() -> None:
    assert not deviation("x", np.array([np.nan]), np.array([1.0]), 1.0).passed
    assert not deviation("x", np.array([np.nan]), np.array([np.nan]), 1.0).passed
    assert deviation("x", np.array([3.0]), np.array([np.nan]), 1.0).passed


def test_command_exits_1_on_a_deviation_and_on_an_unknown_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = read(FILES["motor_command_map"]).frame.copy()
    frame.loc[0, "ref0_f32_min"] += 1.0
    frame.to_csv(tmp_path / "motor_command_map.csv.gz", index=False)
    pd.DataFrame({"a": [1]}).to_csv(tmp_path / "surprise.csv.gz", index=False)
    monkeypatch.setattr(sys, "argv", ["golden_check", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("tests.golden_check", run_name="__main__")
    assert ended.value.code == 1
    said = capsys.readouterr().out
    assert "reference speed, single precision" in said
    assert "no check is known" in said
    assert "2 out of tolerance" in said
