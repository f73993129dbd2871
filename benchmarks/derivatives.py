"""Jacobian and gradient of 64 flights in units of one forward run of them."""

from __future__ import annotations

import sys

from benchmarks.table import Bar, Section, figure, seconds
from benchmarks.timing import Contestant, Spread, compete

FLIGHTS, SAMPLES, REVERSED = 64, 2000, 8
FORWARD, JACOBIAN, GRADIENT = "forward", "jacobian", "gradient"
OURS = (sys.executable, "-m", "benchmarks.contestants.ours")
ROUNDS = 11
STEPS = REVERSED * SAMPLES * 10


def measure() -> Section:
    """Run all three in turn."""
    measured = {
        contestant.name: contestant
        for contestant in compete(
            [
                Contestant(what, (*OURS, "derivatives", what), {})
                for what in (FORWARD, JACOBIAN, GRADIENT)
            ],
            ROUNDS,
        )
    }
    loss, jacobian = (
        _time(contestant.rate)
        for contestant in compete(
            [Contestant(what, (*OURS, "fit", what), {}) for what in ("loss", JACOBIAN)], ROUNDS
        )
    )
    times = {name: _time(contestant.rate) for name, contestant in measured.items()}
    memory = float(measured[GRADIENT].remark)
    base = times[FORWARD].median
    rows = [
        *([name, seconds(times[name]), figure(times[name].median / base)] for name in measured),
        ["reference flights: loss", seconds(loss), "1"],
        ["reference flights: jacobian", seconds(jacobian), figure(jacobian.median / loss.median)],
    ]
    return Section(
        "Derivatives of 64 flights",
        f"{FLIGHTS} flights of {SAMPLES / 100:g} s at 1 kHz, 13 states logged at 100 Hz, float64, "
        "a thread a core, the log on the host. The Jacobian is by 12 coefficients that all flights "
        "share, forward mode, by a kernel; the gradient by 12 coefficients of each flight, reverse "
        f"mode, by XLA on one core, of {REVERSED} flights and counted for {FLIGHTS}. Below, the "
        "four reference flights as a search has them, latencies, filters and clocks included: "
        "their loss, and with it gradient and Hessian by 12 coefficients.",
        ["", "s", "forward runs"],
        rows,
        [
            Bar(
                "Jacobian of 12 coefficients over 64 flights",
                times[JACOBIAN].median / base,
                9,
                "at most",
                " forward runs",
            ),
            Bar(
                "Jacobian of the four reference flights",
                jacobian.median / loss.median,
                9,
                "at most",
                " forward runs",
            ),
            Bar(
                "temporary memory of the reverse gradient",
                memory / STEPS,
                20,
                "at most",
                " bytes a vehicle-step",
            ),
        ],
    )


def _time(rate: Spread | None) -> Spread:
    assert rate is not None
    return Spread(1 / rate.median, 1 / rate.high, 1 / rate.low)
