"""The figures of ``plots/`` drawn by another process, while the rest of a run goes on.

``python -m tuner.report.background`` reads a folder's name from its input, draws what the folder
holds by then, and prints the keys of the figures, and when it began and ended.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

from tuner.core.spans import add_beside
from tuner.report.contents import read_contents
from tuner.report.paper import write_plots
from tuner.report.sections import sections_of


class BackgroundDrawing:
    """A process that draws a folder's figures; it starts up as soon as this is made."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tuner.report.background"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def begin(self, folder: Path) -> None:
        """Have it draw what a result folder holds now."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{folder.resolve()}\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return  # it did not start; `wait` will return no key

    def wait(self) -> frozenset[str]:
        """Wait for its end, and return the keys of the figures that it has written.

        They are none if it could not draw: then the caller draws them.
        """
        output, _ = self._process.communicate()
        if self._process.returncode != 0:
            return frozenset()
        answer = json.loads(output)
        add_beside("figures", *answer["times"])
        return frozenset(answer["keys"])


def main() -> None:
    """Draw one folder's figures and print their keys."""
    folder = sys.stdin.readline().rstrip("\n")
    if not folder:
        return  # the run ended before it had anything to draw
    began = time.time()
    contents = read_contents(folder)
    charts = [chart for section in sections_of(contents) for chart in section.charts]
    write_plots(charts, contents.folder)
    answer = {"keys": [chart.key for chart in charts], "times": [began, time.time()]}
    sys.stdout.write(json.dumps(answer))


if __name__ == "__main__":
    from matplotlib import pyplot  # noqa: F401 (takes a second, during which the run goes on)

    main()
