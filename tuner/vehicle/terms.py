"""The registry's rows of the terms beyond Gazebo's motor model, which a vehicle may lack.

Each is read by a term of `sim_jax.terms`, by the motors' lag or by the battery; absent, or at its
neutral value, it does not act and costs nothing. Coefficients of one group are chosen together.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from tuner.vehicle.coefficient import EFFECTS, Coefficient, ExportTag, NoExportTag

_AXES = {"x": "forward", "y": "left", "z": "up"}
_CENTRED = {"x": 0.01, "y": 0.01, "z": 0.03}
"""m by which the centre of mass is usually elsewhere: builders balance a vehicle about its rotors,
but how far below them its battery hangs is rarely measured."""

#: What does nothing at zero, and what does nothing at one and is searched by its logarithm.
_effect = partial(Coefficient, scale="linear", neutral=0.0)
_ratio = partial(Coefficient, scale="log", neutral=1.0)


_ROWS = (
    _effect(
        "battery_exponent",
        "",
        "power of the battery's voltage with which rotor speeds go",
        "thesis 10.4: speed × (V/V_ref)^γ",
        group="battery",
        part="motors",
        bounds=3.0,
        prior_sd=0.5,
        step=0.2,
        reads="battery_voltage",
        exported_as={
            "sdf": NoExportTag("the motor plugins know no battery", 0.0),
            "px4": NoExportTag("the SIH model's thrust does not depend on the battery", 0.0),
        },
    ),
    _ratio(
        "rotor_drag_ratio_y",
        "",
        "rotor drag along left over that along forward",
        "thesis 10.4, drag that differs between axes",
        group="rotor_drag_ratio",
        bounds=5.0,
        prior_sd=0.4,
        step=0.2,
    ),
    *(
        _effect(
            f"linear_drag_{axis}",
            "N s/m",
            f"drag of the body along {direction} per air velocity",
            "Faessler, Franchi and Scaramuzza 2018: -c·v",
            group="linear_drag",
            bounds=2.0,
            prior_sd=0.2,
            step=0.1,
            mass_exponent=1,
            length_exponent=-0.5,
            is_aggregate=True,
            exported_as={"px4": ExportTag("SIH_KDV")},
        )
        for axis, direction in _AXES.items()
    ),
    _effect(
        "fuselage_drag",
        "N s²/m²",
        "drag of the body per squared air velocity, opposite to it",
        "quadratic drag of a bluff body, F = -d‖v‖v",
        group="fuselage_drag",
        bounds=0.5,
        prior_sd=0.05,
        step=0.02,
        mass_exponent=1,
        length_exponent=-1.0,
        informed_by="speed",
        exported_as={
            "sdf": NoExportTag("the motor plugins know no drag of the body", 0.0),
            "px4": NoExportTag("the SIH model's drag is linear in the velocity", 0.0),
        },
    ),
    _effect(
        "thrust_exponent",
        "",
        "power of the rotor speed with which thrust and drag torque grow, about the hover's",
        "thrust stands: blades at low Reynolds numbers, or that bend",
        group="thrust_exponent",
        bounds=0.7,
        prior_sd=0.05,
        step=0.05,
        neutral=2.0,
        exported_as={
            "sdf": NoExportTag("the motor plugins' thrust goes with the squared rotor speed", 2.0),
            "px4": NoExportTag("the SIH model's thrust goes with the command", 2.0),
        },
    ),
    _effect(
        "thrust_inflow_coefficient",
        "N s²/(rad m)",
        "thrust lost per rotor speed and axial air velocity, signed",
        "blade element theory, advance ratio (thesis 6): T = kΩ² - k_v·Ω·v∥",
        group="thrust_inflow",
        bounds=5e-3,
        prior_sd=2e-4,
        step=1e-4,
        mass_exponent=1,
        exported_as={
            "sdf": NoExportTag(
                "the motor plugins' thrust falls with the length of the axial airspeed, unsigned",
                0.0,
            )
        },
    ),
    *(
        _effect(
            f"center_of_mass_{axis}",
            "m",
            f"centre of mass towards {direction}, from where rotor positions count",
            "a battery is never quite in the middle",
            group="center_of_mass",
            bounds=0.1,
            prior_sd=_CENTRED[axis],
            step=0.005,
            length_exponent=1.0,
            exported_as={
                "sdf": ExportTag("pose", "centre"),
                "px4": NoExportTag("the control allocation is left as it flew", 0.0),
            },
        )
        for axis, direction in _AXES.items()
    ),
    *(
        _ratio(
            f"rotor_thrust_scale_{number}",
            "",
            f"thrust and torque of rotor {number} over the motor constant's; their product is 1",
            "motors and propellers differ by some percent",
            group="rotor_thrust_scale" if number < 4 else "",
            bounds=1.5,
            prior_sd=0.03,
            step=0.015,
            exported_as={"sdf": ExportTag("motorConstant", "rotor")},
        )
        for number in range(1, 5)
    ),
    *(
        _effect(
            f"torque_trim_{axis}",
            "N m",
            f"steady moment about {direction}",
            "blades and motors that are mounted unevenly",
            group="torque_trim",
            part="turning",
            bounds=0.5,
            prior_sd=0.02,
            step=0.005,
            mass_exponent=1,
            length_exponent=1.0,
            is_aggregate=True,
        )
        for axis, direction in _AXES.items()
    ),
    _effect(
        "rotor_inertia",
        "kg m²",
        "moment of inertia of one rotor about its axis",
        "Euler's equations of a body with rotors: -ω × h - dh/dt",
        group="rotor_inertia",
        part="turning",
        bounds=1e-2,
        prior_sd=5e-5,
        step=2e-5,
        mass_exponent=1,
        length_exponent=2.0,
        exported_as={
            "sdf": NoExportTag(
                "the rotor links' inertia turns no body in the motor model's moment", 0.0
            )
        },
    ),
    _effect(
        "time_constant_slope",
        "",
        "relative growth of the time constants per relative rotor speed above hover",
        "thesis 5: bench and flight disagree",
        group="time_constant_slope",
        part="motors",
        bounds=3.0,
        prior_sd=0.5,
        step=0.2,
    ),
    _effect(
        "time_constant_second",
        "s",
        "second lag of the motors, between a command's speed and the rotor's own lag",
        "motor current, and speed controllers that smooth their command",
        group="motor_lag",
        part="motors",
        bounds=0.03,
        prior_sd=0.003,
        step=0.002,
        is_lag=True,
        begin=0.004,
        equivalent_to="actuator_latency",
    ),
    _effect(
        "flapping_moment_coefficient",
        "N s²/rad",
        "moment across the velocity per rotor speed and in-plane air velocity",
        "Mahony, Kumar and Corke 2012; Prouty: k·Ω·(e_z × v⊥)",
        group="flapping_moment",
        part="turning",
        bounds=1e-3,
        prior_sd=2e-5,
        step=5e-6,
        mass_exponent=1,
        length_exponent=1.0,
    ),
    _effect(
        "ground_effect",
        "",
        "gain of thrust near the ground over Cheeseman and Bennett's",
        "Cheeseman and Bennett 1955: T/(1 - g·(R/4h)²)",
        group="ground_effect",
        bounds=8.0,
        prior_sd=2.0,  # four rotors lift by more than one: Sanchez-Cuevas, Heredia, Ollero 2017
        step=0.5,
        expected=True,
    ),
    *(
        _effect(
            f"angular_drag_{axis}",
            "N m s/rad",
            f"damping of rotation about {_AXES[axis]}",
            source,
            group="angular_drag",
            part="turning",
            bounds=0.5,
            prior_sd=usual,
            step=0.5 * usual,
            mass_exponent=1,
            length_exponent=1.5,
            is_aggregate=True,
            exported_as={"px4": ExportTag("SIH_KDW")},
        )
        for axis, usual, source in (
            ("x", 0.01, "what is left of inflow and flapping: -c·ω"),
            ("y", 0.01, "what is left of inflow and flapping: -c·ω"),
            # where inflow and flapping take nothing
            ("z", 0.003, "blades that turn against the air, not the body: -c·ω, c = 2·k_m·k_f·ΣΩ"),
        )
    ),
    *(
        _ratio(
            f"torque_gain_{axis}",
            "",
            f"share of the angular acceleration about {direction} that predicts turning",
            "Ljung, System Identification, 13.4: inputs that answer unseen disturbances",
            bounds=50.0,
            prior_sd=0.7,
            step=0.2,
            exported_as={
                target: NoExportTag(
                    "a simulated loop's rotors answer what it simulates, and no more"
                )
                for target in ("sdf", "px4")
            },
        )
        for axis, direction in _AXES.items()
    ),
)


def _with_defaults(row: Coefficient) -> Coefficient:
    """Return a row with its place, and what Gazebo and PX4 say where it says nothing of them.

    A number searched itself has its bounds about its neutral value.
    """
    ratio = row.scale == "log"
    kind, neutral, bounds = "ratio" if ratio else "term", row.neutral or 0.0, row.bounds
    if not ratio and isinstance(bounds, float):
        bounds = (neutral - bounds, neutral + bounds)
    lost = {
        "sdf": NoExportTag(f"Gazebo's motor model has no such {kind}", neutral),
        "px4": NoExportTag(f"the SIH model has no such {kind}", neutral),
    }
    held = lost | dict(row.exported_as)
    return replace(row, place=(EFFECTS, row.name), bounds=bounds, exported_as=held)


EFFECT_ROWS = tuple(map(_with_defaults, _ROWS))
