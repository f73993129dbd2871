import re
import shutil

import numpy as np

from examples import simulate_bench


def test_the_shipped_recordings_come_from_the_script(tmp_path, monkeypatch, capsys):
    shipped = simulate_bench.FOLDER
    shutil.copy(shipped / "truth.yaml", tmp_path)
    monkeypatch.setattr(simulate_bench, "FOLDER", tmp_path)
    simulate_bench.main()
    recordings = sorted(shipped.glob("*.csv"))
    assert len(recordings) == 7
    for path in recordings:
        tables = [
            np.genfromtxt(place / path.name, delimiter=",", names=True).tolist()
            for place in (shipped, tmp_path)
        ]
        np.testing.assert_allclose(*tables, rtol=1e-4, atol=1e-6)
    plan = (shipped / "bench.yaml").read_text()
    for point in re.findall(r"\{.*?\}", capsys.readouterr().out):
        assert point.replace(".0,", ",") in plan
