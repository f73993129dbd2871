"""The content of ``global_sensitivity.json``: indices of global sensitivity."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tuner.core.disk import write_text
from tuner.core.files import Part, ResultFile, csv_text

Method = Literal["morris", "sobol"]
GLOBAL_TABLE = "global_sensitivity.csv"

#: Method -> what the attributes `main`, `total` and `spread` of a `SensitivityIndex` are.
MEANING = {
    "morris": ("mean effect μ", "mean absolute effect μ*", "standard deviation of the effect σ"),
    "sobol": ("first-order index", "total index", "95 % confidence of the total index"),
}


class SensitivityIndex(Part):
    """Effect of one coefficient on the logarithm of one RMSE; see `MEANING`.

    ``flight`` and ``channel`` are empty for the mean over all of them.
    """

    coefficient: str
    flight: str
    channel: str
    main: float
    total: float
    spread: float


class GlobalSensitivity(ResultFile):
    """The content of ``global_sensitivity.json``.

    Attributes
    ----------
    method
        Of Morris or of Sobol.
    bounds
        Coefficient -> between which values it was varied.
    simulations, crashed
        How many vehicles were simulated, and how many of them crashed on some flight.
    indices
        Coefficient by coefficient, output by output.
    """

    FILE = "global_sensitivity.json"

    method: Method
    bounds: dict[str, tuple[float, float]]
    simulations: int
    crashed: int
    indices: list[SensitivityIndex]

    def write(self, folder: Path) -> None:
        """Write ``global_sensitivity.json`` and, for other programs, ``.csv``."""
        super().write(folder)
        header = ("coefficient", "flight", "channel", *MEANING[self.method])
        rows = [
            [i.coefficient, i.flight or "all", i.channel or "all", i.main, i.total, i.spread]
            for i in self.indices
        ]
        write_text(folder / GLOBAL_TABLE, csv_text(header, rows))
