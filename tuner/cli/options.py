"""Options that several commands share, with one help text each."""

from __future__ import annotations

import math
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

if TYPE_CHECKING:
    from tuner.config import Options

#: The command line as the user typed it, for the record of a run.
TYPED: ContextVar[str] = ContextVar("TYPED", default="")

#: The option takes all words up to the next option.
Many = Parameter(consume_multiple=True, negative=())
#: The option takes no word.
Switch = Annotated[bool, Parameter(negative=())]

Flights = Annotated[
    list[str],
    Many,
    Parameter(help="Use these recordings: paths as the shell expands them, or a quoted glob."),
]
VehicleName = Annotated[
    str,
    Parameter(help="Fly this vehicle file, or a shipped one by its name, say hovergames_updated."),
]
ControllerName = Annotated[
    str,
    Parameter(help="Fly this controller file, or a shipped one by its name: hovergames_sitl."),
]
VehicleChoice = Annotated[
    str | None,
    Parameter(
        help="Start from this vehicle file or shipped vehicle. Default: the job file's, else "
        "hovergames."
    ),
]
ControllerChoice = Annotated[
    str | None,
    Parameter(
        help="Simulate this controller file or shipped controller, the one that flew. Default: "
        "the job file's, else hovergames."
    ),
]
Mass = Annotated[
    float | None,
    Parameter(help="Use this weighed take-off mass in kg instead of the vehicle file's."),
]
JobChoice = Annotated[
    str | None,
    Parameter(
        help="Read the settings from this job file. Default: tune.yaml beside the flights, if "
        "there is one."
    ),
]
Topics = Annotated[
    str | None,
    Parameter(
        help="Find signals by this topic map, or a shipped one by its name. Default: the shipped "
        "map that finds the most signals."
    ),
]
Namespace = Annotated[
    str | None, Parameter(help="Expect this prefix before the topics that the topic map names.")
]
Workers = Annotated[
    int | None,
    Parameter(help="Compute what is independent in this many local processes, a core each."),
]
Cluster = Annotated[
    str | None,
    Parameter(
        help="Compute what is independent on a Dask cluster: a cluster file, or tcp://HOST:8786."
    ),
]
Quiet = Annotated[bool, Parameter(help="Print nothing but errors.", negative=())]
Verbose = Annotated[
    bool, Parameter(help="Print all that the report says, and each message.", negative=())
]
Method = Annotated[
    Literal["auto", "gradient", "cma", "hybrid"] | None,
    Parameter(help="Search with this method. Default: the job file's, else auto."),
]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """What is fitted to which flights, on this machine or on a server.

    Attributes
    ----------
    holdout
        Evaluate these flights without fitting them.
    fit
        Fit exactly these coefficients.
    fix
        Fit the usual coefficients except these.
    seed
        Start the random numbers from this seed. Default: the job file's, else 0.
    """

    flights: Flights
    holdout: Annotated[list[str] | None, Many] = None
    vehicle: VehicleChoice = None
    controller: ControllerChoice = None
    mass: Mass = None
    config: JobChoice = None
    topics: Topics = None
    namespace: Namespace = None
    fit: Annotated[list[str] | None, Many] = None
    fix: Annotated[list[str] | None, Many] = None
    method: Method = None
    seed: int | None = None

    def options(self, *, bench: str | None = None) -> Options:
        """Return them as every inlet of the program takes them."""
        from tuner.config import Options

        return Options(**vars(self), bench=bench)


def lengths(option: str, word: str) -> tuple[float, ...]:
    """Return the numbers of a word such as ``8,6,3``.

    Raises
    ------
    InputError
        The word holds anything but numbers above zero.
    """
    from tuner.core.errors import InputError

    try:
        numbers = tuple(float(part) for part in word.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(math.isfinite(n) and n > 0 for n in numbers):
        raise InputError(option, f"'{word}' is not a list of lengths in m", "write it as 8,6,3")
    return numbers
