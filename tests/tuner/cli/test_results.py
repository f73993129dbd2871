"""Tables of a run: what is not simulated is no crash."""

from tests.tuner.exporters.conftest import make_run  # noqa: F401 (a fixture)
from tuner.cli.results import print_run
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
    print_run(run.folder, run.result.model_copy(update={"flights": (followed, fell)}))
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines if line.split()[:1] == ["followed"] and "–" in line]
    assert [row.count("–") for row in rows] == [3, 2]  # attitude; attitude and body rate
    assert not any("crash" in cell for row in rows for cell in row)
    (row,) = (line for line in lines if line.split()[:1] == ["fell"])
    assert row.count("crash") == 6
    *_, starts = starts_in_words((followed, fell))
    assert "followed x 0.01 m, y 0.02 m, z 0.03 m; fell crashes" in starts
