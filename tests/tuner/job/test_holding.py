"""What the flights leave open is held; what they show through disturbances stays."""

from types import SimpleNamespace

import numpy as np
import pytest

from tuner.job import holding
from tuner.job.holding import stand_ins_of, with_undetermined_held
from tuner.uncertainty.verdict import Reason, ReasonCode


def known(error, *, beyond_noise, code=ReasonCode.WIDE_INTERVAL):
    """Return the uncertainty of one coefficient."""
    estimate = SimpleNamespace(reason=Reason(code=code), identifiable=code is ReasonCode.INTERVAL)
    return SimpleNamespace(
        names=("time_constant_up",),
        estimates={"time_constant_up": estimate},
        covariance=SimpleNamespace(
            data_error=np.array([error]), beyond_noise=np.array([beyond_noise])
        ),
        reference=np.ones(1),
        directions=(),
    )


@pytest.mark.parametrize(
    ("uncertainty", "held"),
    [
        (known(0.1, beyond_noise=1.0, code=ReasonCode.INTERVAL), False),
        (known(0.4, beyond_noise=1.0), True),
        (known(0.4, beyond_noise=50.0), False),
        (known(20.0, beyond_noise=50.0, code=ReasonCode.NO_INFORMATION), True),
        (known(0.4, beyond_noise=50.0, code=ReasonCode.PRIOR_DOMINATES), True),
    ],
    ids=["known", "noise leaves it open", "gusts do", "neither tells", "the prior alone tells"],
)
def test_what_is_held(uncertainty, held):
    assert bool(stand_ins_of(uncertainty)) is held


@pytest.mark.parametrize(("after", "is_held"), [(1000.5, True), (990.0, True), (1040.0, False)])
def test_what_trades_off_is_held_only_where_that_costs_nothing(monkeypatch, after, is_held):
    objective = SimpleNamespace(
        segments=SimpleNamespace(windowed=True, freedom=None),
        sums=lambda point, *_, **__: SimpleNamespace(loss=np.array([point, 0.0])),
    )
    fitted = SimpleNamespace(objective=objective, criterion=None, point=1000.0, held={})
    traded = {"motor_constant": "input_scaling", "input_scaling": "input_scaling"}
    alone = {"time_constant_up": "time_constant_up"}  # open by itself: predicting fits keep it
    monkeypatch.setattr(holding, "alternatives_of", lambda _: None)
    monkeypatch.setattr(holding, "examine", lambda *_, **__: SimpleNamespace(uncertainty=None))
    monkeypatch.setattr(holding, "stand_ins_of", lambda _: traded | alone)

    def hold(_, fitted, stand_ins, __):
        assert stand_ins == traded
        return SimpleNamespace(**vars(fitted) | {"point": after, "held": stand_ins})

    monkeypatch.setattr(holding, "hold", hold)
    said = []
    rest, _ = with_undetermined_held(None, fitted, lambda *_: None, said.append)
    assert rest.held == (traded if is_held else {})
    assert ("all keep their values" in said[-1]) is not is_held
