"""What the flights leave open is held; what they show through disturbances stays."""

from types import SimpleNamespace

import numpy as np
import pytest

from tuner.config import JobFile
from tuner.search.listener import Listener, Reporter
from tuner.terms.candidates import SelectionResult
from tuner.uncertainty import identifiability
from tuner.uncertainty.identifiability import hold_undetermined, stand_ins_of
from tuner.uncertainty.verdict import Reason, ReasonCode
from tuner.vehicle.selection_table import SelectionCode, SelectionRow


def known(error, *, beyond_noise, code=ReasonCode.WIDE_INTERVAL, name="time_constant_up"):
    """Return the uncertainty of one coefficient."""
    estimate = SimpleNamespace(reason=Reason(code=code), identifiable=code is ReasonCode.INTERVAL)
    return SimpleNamespace(
        names=(name,),
        estimates={name: estimate},
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
        (known(0.4, beyond_noise=1.0, name="max_relative_airspeed"), False),
    ],
    ids=[
        "known",
        "noise leaves it open",
        "gusts do",
        "neither tells",
        "the prior alone tells",
        "of a law that is not followed",
    ],
)
def test_held_coefficients(uncertainty, held):
    assert bool(stand_ins_of(uncertainty)) is held


@pytest.mark.parametrize(("after", "is_held"), [(1000.5, True), (990.0, True), (1040.0, False)])
def test_coefficients_that_trade_off_are_held_only_where_that_costs_nothing(
    monkeypatch, after, is_held
):
    objective = SimpleNamespace(
        segments=SimpleNamespace(windowed=True, start_sd=None),
        sums=lambda point, *_, **__: SimpleNamespace(loss=np.array([point, 0.0])),
    )
    fitted = SimpleNamespace(objective=objective, criterion=None, point=1000.0, held={})
    traded = {"motor_constant": "input_scaling", "input_scaling": "input_scaling"}
    alone = {"time_constant_up": "time_constant_up"}  # open by itself: predicting fits keep it
    monkeypatch.setattr(identifiability, "alternatives_of", lambda *_: None)
    monkeypatch.setattr(identifiability, "model_errors_of", lambda *_: None)
    nothing = SimpleNamespace(uncertainty=SimpleNamespace(names=()))
    monkeypatch.setattr(identifiability, "examine", lambda *_, **__: nothing)
    monkeypatch.setattr(identifiability, "stand_ins_of", lambda _: traded | alone)

    def hold(_, fitted, stand_ins, __, **___):
        assert stand_ins == traded
        return SimpleNamespace(**vars(fitted) | {"point": after, "held": stand_ins})

    monkeypatch.setattr(identifiability, "hold", hold)
    said = []
    job = SimpleNamespace(settings=SimpleNamespace(job=JobFile()), fitted=())
    rest, _ = hold_undetermined(job, fitted, Reporter(Listener(on_message=said.append)))
    assert rest.held == (traded if is_held else {})
    assert ("all keep their values" in said[-1]) is not is_held


IDLE = {"name": "ground_effect", "bound": "upper", "code": ReasonCode.NULL_DIRECTION}


@pytest.mark.parametrize("start_sd", [None, 1.0], ids=["recorded starts", "free starts"])
@pytest.mark.parametrize(
    ("idle", "file", "goes"),
    [
        (IDLE, JobFile(), True),
        (IDLE | {"bound": None}, JobFile(), False),
        (IDLE | {"code": ReasonCode.INTERVAL}, JobFile(), False),
        (IDLE, JobFile(terms=["ground_effect"]), False),
        (IDLE, JobFile(free=["ground_effect"]), False),
        (IDLE | {"name": "motor_constant"}, JobFile(), False),
        (IDLE | {"name": "max_relative_airspeed"}, JobFile(), False),
    ],
    ids=["idle", "inside", "identified", "named", "asked to be free", "of the base model", "a law"],
)
def test_a_term_at_its_bound_that_flights_do_not_identify_is_removed(
    monkeypatch, start_sd, idle, file, goes
):
    """Though the fitted flights lose by it, and though it is held for another one already."""
    name, objective = idle["name"], SimpleNamespace(segments=SimpleNamespace(windowed=True))
    objective.segments.start_sd = start_sd
    traded = {name: "input_scaling", "input_scaling": "input_scaling"}
    fitted = SimpleNamespace(objective=objective, point=None, held=traded)
    estimate = SimpleNamespace(reason=Reason(code=idle["code"], bound=idle["bound"]))
    examined = SimpleNamespace(
        uncertainty=SimpleNamespace(names=(name,), estimates={name: estimate})
    )
    monkeypatch.setattr(identifiability, "alternatives_of", lambda *_: None)
    monkeypatch.setattr(identifiability, "model_errors_of", lambda *_: None)
    monkeypatch.setattr(identifiability, "examine", lambda *_, **__: examined)
    monkeypatch.setattr(identifiability, "stand_ins_of", lambda _: traded)

    def hold(_, fitted, stand_ins, __, **___):
        return SimpleNamespace(**vars(fitted) | {"held": stand_ins})

    monkeypatch.setattr(identifiability, "hold", hold)
    terms = {"ground_effect": ("ground_effect",)}
    settings = SimpleNamespace(job=file)
    job, said = SimpleNamespace(settings=settings, first_terms=terms, fitted=()), []
    rest, _ = hold_undetermined(job, fitted, Reporter(Listener(on_message=said.append)))
    assert rest.held == (traded | {name: name} if goes else traded)
    assert any("taken out of the model" in line for line in said) is goes

    chosen = SelectionRow(
        group=name, names=(name,), kept=True, reason=SelectionCode.PREDICTS_SECTIONS
    )
    asked = chosen.model_copy(update={"reason": SelectionCode.ASKED_FOR})
    after, *others = SelectionResult(job, rest, (chosen, asked)).rows_after_holding
    assert after.kept is not goes
    assert (after.reason is SelectionCode.NO_INFORMATION) is goes
    assert others == [asked]


def test_where_thrust_inflow_and_the_law_of_airspeed_trade_off_the_law_stays():
    names = ("max_relative_airspeed", "thrust_inflow_coefficient")
    lost = SimpleNamespace(reason=Reason(code=ReasonCode.NULL_DIRECTION), identifiable=False)
    traded = SimpleNamespace(moves=dict(zip(names, (0.6, 0.8), strict=True)), null=True)
    uncertainty = SimpleNamespace(
        names=names,
        estimates=dict.fromkeys(names, lost),
        covariance=SimpleNamespace(data_error=np.full(2, 9.0), beyond_noise=np.ones(2)),
        reference=np.ones(2),
        directions=(traded,),
    )
    assert stand_ins_of(uncertainty) == dict.fromkeys(names, "max_relative_airspeed")
