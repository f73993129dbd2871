"""Every coefficient of the model, one row each: all that the rest of the program knows of it.

To add a coefficient, add its row and use it in a term of `sim_jax`; the vehicle file, the search,
the verdicts, the report, the exports and the documentation follow from the row. "Thesis" is M. te
Braake, "Improving the PX4 software-in-the-loop multirotor UAV simulator accuracy"; Table 10.1
there lists the values of the coefficients of Gazebo's motor model.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping

from tuner.vehicle.coefficient import Coefficient, ExportTag, NoExportTag, Scope
from tuner.vehicle.flight_conditions import SURROUNDING_ROWS
from tuner.vehicle.terms import EFFECT_ROWS

_FROM_SPEEDS = ExportTag("CA_ROTOR*_CT, SIH_T_MAX, SIM_GZ_EC_*")

NO_LOSS = 1e6
"""m/s, of ``max_relative_airspeed`` in a simulator whose thrust does not depend on the airspeed."""

_ROWS = (
    # mass and inertia
    Coefficient(
        name="mass",
        unit="kg",
        meaning="take-off mass",
        source="SDF <mass>; weighed",
        place=("", "mass"),
        bounds=3.0,
        prior_sd=0.3,
        mass_exponent=1,
        hold_rank=0,
        exported_as={"sdf": ExportTag("mass", "inertial"), "px4": ExportTag("SIH_MASS")},
        informed_by="weighing",
    ),
    *(
        Coefficient(
            name=f"inertia_{axes}",
            unit="kg m²",
            meaning=f"moment of inertia about {direction}",
            source=f"SDF <i{axes}>",
            place=("inertia", axes),
            part="turning",
            bounds=8.0,
            prior_sd=0.5,
            free=True,
            mass_exponent=1,
            exported_as={
                "sdf": ExportTag(f"i{axes}", "inertia"),
                "px4": ExportTag(f"SIH_I{axes.upper()}"),
            },
            informed_by=turn,
        )
        for axes, direction, turn in (
            ("xx", "forward", "roll"),
            ("yy", "left", "pitch"),
            ("zz", "up", "yaw"),
        )
    ),
    # from command to rotor speed
    Coefficient(
        name="input_scaling",
        unit="rad/s",
        meaning="rotor speed gained from no command to full",
        source="thesis Eq. 4.2; SDF <input_scaling>",
        place=("motor", "input_scaling"),
        part="motors",
        bounds=4.0,
        prior_sd=0.1,
        free=True,
        hold_rank=1,
        exported_as={"sdf": ExportTag("input_scaling", "channel"), "px4": _FROM_SPEEDS},
        informed_by="thrust curve",
    ),
    Coefficient(
        name="zero_position_armed",
        unit="rad/s",
        meaning="rotor speed at zero command",
        source="thesis Eq. 4.2; SDF <zero_position_armed>",
        place=("motor", "zero_position_armed"),
        part="motors",
        bounds=8.0,
        prior_sd=0.5,
        free=True,
        hold_rank=2,
        exported_as={"sdf": ExportTag("zero_position_armed", "channel"), "px4": _FROM_SPEEDS},
        informed_by="thrust curve",
    ),
    Coefficient(
        name="input_offset",
        unit="",
        meaning="added to the command",
        source="thesis Eq. 4.2; SDF <input_offset>",
        place=("motor", "input_offset"),
        part="motors",
        scale="linear",
        bounds=(-0.5, 0.5),
        prior_sd=0.05,
        step=0.1,
        neutral=0.0,
        exported_as={"sdf": ExportTag("input_offset", "channel"), "px4": _FROM_SPEEDS},
    ),
    Coefficient(
        name="quadratic",
        unit="rad/s",
        meaning="rotor speed per squared unit of command",
        source="thesis 4.4.1, polynomial RPM curves",
        place=("motor", "quadratic"),
        part="motors",
        scale="linear",
        bounds=(-1000.0, 1000.0),
        prior_sd=200.0,
        step=100.0,
        neutral=0.0,
        exported_as={
            "sdf": NoExportTag("the control channels map commands to speeds by a line", 0.0),
            "px4": _FROM_SPEEDS,
        },
    ),
    *(
        Coefficient(
            name=f"time_constant_{way}",
            unit="s",
            meaning=f"lag of a rotor that {changes}",
            source=f"thesis Eq. 5.3; SDF <{tag}>",
            place=("motor", f"time_constant_{way}"),
            part="motors",
            bounds=20.0,
            prior_sd=0.7,
            free=True,
            exported_as={"sdf": ExportTag(tag, "motor"), "px4": ExportTag("SIH_T_TAU")},
            informed_by="rotor lag",
            plausible=(0.001, 1.0),
        )
        for way, changes, tag in (
            ("up", "speeds up", "timeConstantUp"),
            ("down", "slows down", "timeConstantDown"),
        )
    ),
    # from rotor speed and air velocity to force and moment
    Coefficient(
        name="motor_constant",
        unit="N s²/rad²",
        meaning="thrust per squared rotor speed",
        source="thesis Eq. 6.5; SDF <motorConstant>",
        place=("aerodynamics", "motor_constant"),
        bounds=8.0,
        prior_sd=0.5,
        free=True,
        mass_exponent=1,
        exported_as={
            "sdf": ExportTag("motorConstant", "motor"),
            "px4": ExportTag("CA_ROTOR*_CT, SIH_T_MAX, MPC_THR_HOVER"),
        },
        informed_by="thrust",
    ),
    Coefficient(
        name="moment_constant",
        unit="m",
        meaning="drag torque per thrust",
        source="thesis Eq. 7.2; SDF <momentConstant>",
        place=("aerodynamics", "moment_constant"),
        part="turning",
        bounds=12.0,
        prior_sd=0.7,
        free=True,
        exported_as={
            "sdf": ExportTag("momentConstant", "motor"),
            "px4": ExportTag("CA_ROTOR*_KM, SIH_Q_MAX"),
        },
        informed_by="yaw",
        plausible=(0.001, 0.5),
    ),
    Coefficient(
        name="rotor_drag_coefficient",
        unit="N s²/(rad m)",
        meaning="drag in the rotor plane per rotor speed and air velocity",
        source="thesis Eq. 8.2; SDF <rotorDragCoefficient>",
        place=("aerodynamics", "rotor_drag_coefficient"),
        bounds=40.0,
        prior_sd=1.5,
        free=True,
        mass_exponent=1,
        exported_as={
            "sdf": ExportTag("rotorDragCoefficient", "motor"),
            "px4": ExportTag("SIH_KDV"),
        },
        informed_by="speed",
    ),
    Coefficient(
        name="rolling_moment_coefficient",
        unit="N s²/rad",
        meaning="moment in the rotor plane per rotor speed and air velocity",
        source="thesis Eq. 9.2; SDF <rollingMomentCoefficient>",
        place=("aerodynamics", "rolling_moment_coefficient"),
        part="turning",
        bounds=1000.0,
        prior_sd=2.0,
        mass_exponent=1,
        exported_as={
            "sdf": ExportTag("rollingMomentCoefficient", "motor"),
            "px4": NoExportTag("the SIH model has no rolling moment", 0.0),
        },
        informed_by="nothing",
    ),
    Coefficient(
        name="max_relative_airspeed",
        unit="m/s",
        meaning="axial airspeed at which thrust vanishes",
        source="thesis Eq. 6.6; 25 m/s in gazebo_motor_model.cpp",
        place=("aerodynamics", "max_relative_airspeed"),
        bounds=1000.0,
        prior_sd=1.0,
        hold_rank=4,
        by_law=25.0,
        group="thrust_inflow",
        exported_as={
            "sdf": NoExportTag("the motor plugins have 25 m/s built in", 25.0),
            "px4": NoExportTag("the SIH model's thrust does not depend on the airspeed", NO_LOSS),
        },
        informed_by="climb",
    ),
    # terms beyond Gazebo's motor model
    *EFFECT_ROWS,
    # what the set-up, each flight and each window add
    *SURROUNDING_ROWS,
)

COEFFICIENTS: dict[str, Coefficient] = {row.name: row for row in _ROWS if row.place[1]}
"""Name -> row of every coefficient that a vehicle file can hold and a job can free."""
REGISTRY: Mapping[str, Coefficient] = ChainMap(
    {row.name: row for row in _ROWS if not row.place[1]}, COEFFICIENTS
)
"""Name -> row, in the order in which tables list them: what each flight has comes last."""


def of_scope(scope: Scope) -> dict[str, Coefficient]:
    """Return name -> row of the coefficients of a scope."""
    return {name: row for name, row in REGISTRY.items() if row.scope == scope}


def scale_group() -> tuple[str, ...]:
    """Return the coefficients whose common factor leaves every motion the same."""
    return tuple(name for name, row in COEFFICIENTS.items() if row.mass_exponent == 1)


def mass_factor(name: str, mass: float | None, wanted: float | None) -> float:
    """Return the factor that converts a coefficient found with one mass, kg, to another.

    It is 1 for an unknown mass, and for the mass itself.
    """
    exponent = 0 if name == "mass" or name not in REGISTRY else REGISTRY[name].mass_exponent
    return float((wanted / mass) ** exponent) if mass and wanted else 1.0


def term_groups() -> dict[str, tuple[str, ...]]:
    """Return every group of terms that a fit may add, with its coefficients."""
    groups: dict[str, tuple[str, ...]] = {}
    for name, row in COEFFICIENTS.items():
        if row.group:
            groups[row.group] = (*groups.get(row.group, ()), name)
    return groups


def condition_rows() -> dict[str, Coefficient]:
    """Return name -> row of per-flight conditions (wind, battery), inputs of a simulation."""
    return {name: row for name, row in of_scope("flight").items() if row.group}


def recording_offsets() -> dict[str, Coefficient]:
    """Return name -> row of constant errors of a recording."""
    return {name: row for name, row in of_scope("flight").items() if not row.group}
