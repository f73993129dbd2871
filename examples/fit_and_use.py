"""From recordings to a simulator, step by step: run it whole, or cell by cell in an editor.

It reads the recordings that ship with the project, and writes into the folder given as its only
argument (``runs/example`` without one).
"""

# %% A recording becomes a flight: arrays on one clock, in SI units.
import sys
from pathlib import Path

import numpy as np

import tuner
from tuner.recordings.notes import note_in_words

LAB = Path(__file__).resolve().parents[1] / "reference_flights"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
OUT.mkdir(parents=True, exist_ok=True)

flight = tuner.load_flight(LAB / "circle_3mps.bag")
speed = np.linalg.norm(flight.signals["velocity"], axis=1)
print(f"{flight.name}: {flight.duration:.0f} s, up to {np.nanmax(speed):.1f} m/s")
for note in flight.notes:
    print(f"  {note.topic or 'recording'}: {note_in_words(note)}")

# %% How far off are the coefficients that the vehicle's model shipped with?
flights = [LAB / "circle_3mps.bag", LAB / "yaw_spin_3rps.bag", LAB / "circle_4mps.bag"]
table = tuner.compare(flights, ["hovergames", "hovergames_updated"], out=[OUT / "before.html"])
print(f"closest so far: {table.best}")

# %% Fit: one circle and one yaw spin, the faster circle held out.
run = tuner.fit(flights, holdout=["circle_4mps"], out=OUT / "run")
for name, coefficient in run.result.coefficients.items():
    if coefficient.fitted:
        print(
            f"{name:26} {coefficient.initial:10.4g} -> {coefficient.best:10.4g} {coefficient.unit}"
        )

# %% The held-out circle, before and after.
held_out = next(flight for flight in run.result.flights if flight.split == "holdout")
print(f"{held_out.name}: {held_out.rmse_initial.x:.4f} m -> {held_out.rmse_best.x:.4f} m along x")

# %% What would a heavier battery do? The fitted vehicle, four masses side by side.
masses = run.vehicle.mass + np.array([0.0, 0.1, 0.2, 0.3])
for heavier in tuner.simulate("circle", vehicle=run.vehicle, speed=3.0, grid={"mass": masses}):
    command = heavier.signals["command"].mean()
    print(f"{heavier.coefficients['mass']:.2f} kg: mean command {command:.3f}")

# %% Into Gazebo and PX4, if the numbers hold there.
model = Path(__file__).resolve().parent / "models" / "quad_x.sdf"
for done in (
    tuner.export(run, "sdf", into=model, out=OUT / "quad_x.sdf"),
    tuner.export(run, "px4", out=OUT / "quad_x.params"),
):
    print(f"wrote {done.path}")
    for remark in done.notes:
        print(f"  {remark}")
