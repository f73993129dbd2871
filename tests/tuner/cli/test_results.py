"""Tables of a run: what is not simulated is no crash; what to log next time is said."""

from tests.tuner.exporters.conftest import make_run  # noqa: F401 (a fixture)
from tuner.cli.results import print_run
from tuner.design.log_proposal import LogProposal
from tuner.result import AxesRmse, PredictedErrors
from tuner.wording.result import starts_in_words


def test_a_followed_attitude_is_no_crash(make_run, capsys):  # noqa: F811
    run = make_run()
    met = AxesRmse(x=0.01, y=0.02, z=0.03, roll=None, pitch=None, yaw=None)
    crashed = AxesRmse(x=None, y=None, z=None, roll=None, pitch=None, yaw=None)
    ahead = PredictedErrors(seconds=0.5, position=0.1, velocity=0.2, attitude=None, body_rate=None)
    followed = run.result.flights[0].model_copy(
        update={
            "name": "followed",
            "horizon": 1.0,
            "rmse_initial": met,
            "rmse_best": met,
            "rmse_fitted_starts": met,
            "predicted_initial": (ahead,),
            "predicted_best": (ahead,),
        }
    )
    fell = run.result.flights[0].model_copy(
        update={"name": "fell", "horizon": 1.0, "rmse_best": crashed, "rmse_fitted_starts": crashed}
    )
    tachometer = LogProposal(
        signal="rotor_speed", change="added", rate=100.0, noise=6.0, shrinks={"motor_constant": 0.5}
    )
    update = {"flights": (followed, fell), "next_log": (tachometer,)}
    print_run(run.folder, run.result.model_copy(update=update))
    out = capsys.readouterr().out
    assert "Log the rotor speed, at 100 Hz and good to 6 rad/s: it would halve" in out
    lines = out.splitlines()
    rows = [line.split() for line in lines if line.split()[:1] == ["followed"] and "–" in line]
    assert [row.count("–") for row in rows] == [3, 2]  # attitude; attitude and body rate
    assert not any("crash" in cell for row in rows for cell in row)
    (row,) = (line for line in lines if line.split()[:1] == ["fell"])
    assert row.count("crash") == 6
    *_, starts = starts_in_words((followed, fell))
    assert "followed x 0.01 m, y 0.02 m, z 0.03 m; fell crashes" in starts
