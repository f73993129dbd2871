"""A vehicle over time: each coefficient as its jobs found it."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import selectinload

from tuner.service.database import Database
from tuner.service.errors import NotKnownError
from tuner.service.names import shown, stems
from tuner.service.shapes import CoefficientHistory, History, Point, iso
from tuner.service.tables import JobRow, PointRow, State
from tuner.vehicle.registry import at_mass

MOST_JOBS = 500
"""Of a history, the latest."""


def history(database: Database, vehicle: str) -> History:
    """Return every fitted coefficient over the jobs of a vehicle that are done.

    They stand in the order in which their recordings were flown, as far as that is known, and else
    in which they were submitted. What goes with the mass is that at the last job's mass: flights
    show only its ratio to the mass.

    Raises
    ------
    NotKnownError
        No job was of this vehicle.
    """
    with database.reading() as session:
        any_job = select(JobRow.number).where(JobRow.vehicle == vehicle).limit(1)
        if not vehicle.isprintable() or session.scalar(any_job) is None:
            raise NotKnownError(f"vehicle {shown(vehicle)}", "has no jobs here", "submit one")
        jobs = session.scalars(
            select(JobRow)
            .where(JobRow.vehicle == vehicle, JobRow.state == State.DONE)
            .order_by(JobRow.number.desc())
            .limit(MOST_JOBS)
            .options(selectinload(JobRow.flights))
        ).all()
        by_number = {job.number: job for job in jobs}
        rows = session.scalars(select(PointRow).where(PointRow.job.in_(by_number))).all()
    moments = {job.number: job.submitted if job.flown is None else job.flown for job in jobs}
    rows = sorted(rows, key=lambda row: (moments[row.job], row.job))
    masses = {row.job: row.best for row in rows if row.coefficient == "mass"}
    mass = next((masses[row.job] for row in reversed(rows) if row.job in masses), None)
    coefficients: dict[str, CoefficientHistory] = {}
    for row in rows:
        if row.coefficient == "mass" and row.identifiable is None:
            continue  # not fitted
        job = by_number[row.job]
        factor, ci95 = at_mass(row.coefficient, masses.get(row.job), mass), None
        if row.lower is not None and row.upper is not None:
            ci95 = (factor * row.lower, factor * row.upper)
        point = Point(
            job=job.id,
            name=job.name,
            flown=iso(job.flown),
            ended=iso(job.ended),
            mass=masses.get(row.job),
            best=factor * row.best,
            std_error=None if row.std_error is None else factor * row.std_error,
            ci95=ci95,
            identifiable=row.identifiable,
            flights=stems(flight.name for flight in job.flights if not flight.holdout),
        )
        empty = CoefficientHistory(unit=row.unit, points=[])
        coefficients.setdefault(row.coefficient, empty).points.append(point)
    return History(vehicle=vehicle, mass=mass, coefficients=coefficients)


def vehicles(database: Database) -> dict[str, int]:
    """Return each vehicle and how many jobs it has."""
    with database.reading() as session:
        statement = select(JobRow.vehicle, func.count()).group_by(JobRow.vehicle)
        rows = session.execute(statement.order_by(JobRow.vehicle)).all()
    return {vehicle: count for vehicle, count in rows}  # noqa: C416 (rows are no pairs to mypy)
