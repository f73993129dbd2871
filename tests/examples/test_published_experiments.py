import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_experiments_show_what_was_published(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "published_experiments.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [line.split() for line in done.stdout.splitlines()]

    hover = {words[0]: [float(word) for word in words[1:]] for words in lines if len(words) == 4}
    assert hover["original"] == pytest.approx([0.672, 772, 0.013], abs=0.6)
    assert hover["original"][::2] == pytest.approx([0.672, 0.013], abs=1.5e-3)
    assert hover["updated"][1] == pytest.approx(616, abs=0.6)
    assert hover["updated"][::2] == pytest.approx([0.543, 0.12], abs=1.5e-3)

    curves = [words for words in lines if "ms" in words]
    assert len(curves) == 2 * 5 * 2
    for words in curves:
        if words[words.index("ms") - 1] == "0":
            assert words[-1] == "steady"
    assert any("oscillates," in words for words in curves)

    circles = [words for words in lines if words[:1] == ["circle"]]
    assert [float(words[1]) for words in circles] == 2 * [2.1, 2.4, 3.2, 4.0]
    original, updated = float(circles[0][2]), float(circles[0][5])
    assert 0.3 < updated < original < 1.0
