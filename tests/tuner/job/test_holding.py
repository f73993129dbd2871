"""What the flights leave open is held; what they show through disturbances stays."""

from types import SimpleNamespace

import numpy as np
import pytest

from tuner.job.holding import stand_ins_of
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
