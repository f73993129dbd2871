"""A worker that fits nothing: it says and does what the job's namespace asks for, quickly.

It needs the standard library alone, and keeps to what the real one promises: a lock on the folder,
an end with its server, a checkpoint that a later attempt goes on from. The result says how many
attempts there were, and what the steps came to.
"""

import fcntl
import json
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path

CRASHED = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"))
AXES = {"x": 0.1, "y": 0.1, "z": 0.1, "roll": 1.0, "pitch": 1.0, "yaw": 1.0}

FIXED = {
    "fitted": False,
    "std_error": None,
    "ci95": None,
    "identifiable": None,
    "verdict": "fixed",
    "reason": {"code": "not_fitted"},
}


def end_with_server():
    sys.stdin.read()
    os._exit(1)


def coefficient(best):
    return {
        "unit": "N s²/rad²",
        "initial": 8e-6,
        "best": best,
        "fitted": True,
        "std_error": 1e-8,
        "ci95": [best - 2e-8, best + 2e-8],
        "identifiable": True,
        "verdict": "well_known",
        "reason": {"code": "interval", "half_width": 0.01},
    }


def main():
    assignment = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_server, daemon=True).start()
    os.chdir(assignment["folder"])
    with Path(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        fit(assignment)


def fit(assignment):
    wish = assignment["asked"].get("namespace") or ""

    def say(kind, **content):
        sys.stdout.write(json.dumps({"kind": kind, **content}) + "\n")
        sys.stdout.flush()

    result = Path("result")
    result.mkdir(exist_ok=True)
    checkpoint = result / "checkpoint.npz"
    began = json.loads(checkpoint.read_text()) if checkpoint.exists() else {"step": 0, "sum": 0}
    say("message", text=f"begins at {began['step']}")
    if wish == "refuse":
        say("refused", error="flights: nothing moves; fly a circle")
        return
    if wish == "fault":
        say("fault", error="ZeroDivisionError: division by zero")
        return
    steps, pause = (40, 0.05) if wish.startswith("slow") else (5, 0.002)
    step, total = began["step"], began["sum"]
    while step < steps:
        step, total = step + 1, total + step
        unfinished = result / "unfinished"
        unfinished.write_text(json.dumps({"step": step, "sum": total}))
        unfinished.replace(checkpoint)
        say(
            "iteration",
            stage="whole length",
            number=step,
            loss=1.0 / step,
            position_rmse=0.1 / step,
            accepted=True,
            horizon=1.0,
            damping=None,
            seconds_left=float(steps - step),
        )
        if wish == "die" or (wish == "die once" and began["step"] == 0):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(pause)
    mass = assignment["asked"].get("mass") or 2.0
    best = total * 1e-8 * mass / 2.0
    row = {"name": "motor_constant", "unit": "N s²/rad²", "initial": 8.5e-6, "estimate": best}
    say("estimates", estimates=[row])
    content = {
        "schema_version": 2,
        "status": "converged",
        "seed": 0,
        "versions": {},
        "settings": {},
        "coefficients": {
            "mass": coefficient(mass) | FIXED | {"unit": "kg"},
            "motor_constant": coefficient(best),
        },
        "flights": [
            {
                "name": Path(name).stem,
                "path": name,
                "sha256": "0" * 64,
                "split": "fit",
                "duration": 1.0,
                "time_offset": 0.0,
                "rmse_initial": AXES,
                "rmse_best": CRASHED if wish == "crash" else AXES,
            }
            for name in assignment["flights"]
        ],
        "findings": [],
        "search": {
            "method": "auto",
            "evaluations": steps,
            "iterations": steps,
            "wall_time": 0.1,
            "cost_initial": 1.0,
            "cost_best": 0.1,
            "converged": True,
            "message": "no_further_gain",
        },
    }
    (result / "result.json").write_text(json.dumps(content))
    vehicle = Path(__file__).parents[3] / "configs" / "vehicles" / "hovergames.yaml"
    text = re.sub("^mass: .*", f"mass: {mass}", vehicle.read_text(), flags=re.MULTILINE)
    text = re.sub("motor_constant: .*", f"motor_constant: {best}", text)
    (result / "best_fit.yaml").write_text(text)
    (result / "report.html").write_text("<!doctype html><title>report</title><p>fitted")
    (result / "plots").mkdir(exist_ok=True)
    (result / "plots" / "one.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    say("done")


main()
