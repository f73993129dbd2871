"""Shapes, and the publisher's wind-up and laps, against the trajectory publisher."""

from __future__ import annotations

from collections.abc import Callable

from sim_jax.geometry import Vec3
from sim_jax.trajectory import Circle, Diagonal, Hover, Lemniscate, Straight, publish
from tests.golden_check.table import Deviation, Table, deviation, merged

SHAPE = 1e-12
UPDATE = 1e-9
SCALER = 2.1
#: Shapes by the names in the golden files.
SHAPES = {
    "circle": Circle,
    "lemniscate": Lemniscate,
    "straight": Straight,
    "diagonal": Diagonal,
    "stationary": Hover,
}


def shapes(table: Table) -> list[Deviation]:
    return merged([_shape(part) for part in table.split("name")])


def _shape(table: Table) -> list[Deviation]:
    shape = SHAPES[table.frame["name"].iloc[0]](
        radius=table.column("radius"),
        omega=table.column("omega"),
        origin=table.vector("o"),
    )
    point = shape.at(table.column("t"))
    return [
        deviation("position", point.position, table.vector("p"), SHAPE),
        deviation("velocity", point.velocity, table.vector("v"), SHAPE),
        deviation("acceleration", point.acceleration, table.vector("a"), SHAPE),
    ]


def publisher(name: str) -> Callable[[Table], list[Deviation]]:
    def check(table: Table) -> list[Deviation]:
        ticks = table.frame["k"].to_numpy()
        start = int(ticks[table.frame["started"].to_numpy() > 0][0])
        sent = publish(
            SHAPES[name](), ticks=int(ticks[-1]) + 1, velocity_scaler=SCALER, start_tick=start
        )
        points = sent.points

        def rows(vector: Vec3) -> Vec3:
            return Vec3(vector.x[ticks], vector.y[ticks], vector.z[ticks])

        return [
            deviation("position", rows(points.position), table.vector("p"), UPDATE),
            deviation("velocity", rows(points.velocity), table.vector("v"), UPDATE),
            deviation("acceleration", rows(points.acceleration), table.vector("a"), UPDATE),
            deviation("time", sent.shape_time[ticks], table.column("trigger_time"), UPDATE),
            deviation("wind-up", sent.windup[ticks], table.column("windup_ratio"), UPDATE),
            deviation("lap", sent.lap[ticks], table.column("lap"), 0.0),
        ]

    return check
