"""The tutorial of the service, against a server whose workers fit nothing."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs the extra 'service'")

from tests.docs.pages import DOCS, ROOT, commands
from tests.tuner.service.conftest import FAKE_WORKER, LIMITS, listening
from tuner.service import attempt
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

PAGE = DOCS / "tutorials" / "service.md"
TUNE = (sys.executable, "-c", "import sys; from tuner.cli import main; sys.exit(main())")
RUN_FOREVER = ("tune serve --host 0.0.0.0", "tune watch-folder")


@pytest.mark.slow
def test_its_commands_talk_to_a_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "reference_flights").symlink_to(ROOT / "reference_flights")
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(attempt, "WORKER", FAKE_WORKER)
    service = Service.open(ServiceSettings(tmp_path / "data", workers=2, limits=LIMITS))
    job = ""
    with listening(service) as client:
        monkeypatch.setenv("TUNE_SERVER", str(client.base_url))
        for line in commands(PAGE):
            if line == "tune serve" or line.startswith(RUN_FOREVER):
                continue
            words = shlex.split(line.replace("JOB", job))[1:]
            called = subprocess.run([*TUNE, *words], check=False, capture_output=True, text=True)
            assert called.returncode == 0, (line, called.stderr)
            job = next(iter(re.findall(r"job ([0-9a-f]{16})", called.stdout)), job)
    assert (tmp_path / "runs" / "from_server" / "result.json").exists()
