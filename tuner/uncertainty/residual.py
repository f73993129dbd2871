"""The residuals of one channel of one flight, as data."""

from __future__ import annotations

from tuner.core.files import Part


class Residual(Part):
    """The residuals of one channel of one flight: white noise, or not.

    Attributes
    ----------
    flight, channel
        Names.
    rms
        In standard deviations of the measurement noise.
    spacing
        s from lag to lag.
    autocorrelation
        (L,) mean over the axes, from lag 0, where it is 1.
    limit
        Half the band within which 95 % of the lags of white noise lie.
    memory
        Correlation time in s: the integral of the autocorrelation's square, on either side of 0; a
        sample's spacing for white noise.
    white
        Whether at most twice the share of lags expected by chance lies outside the band.
    """

    flight: str
    channel: str
    rms: float
    spacing: float
    autocorrelation: list[float]
    limit: float
    memory: float
    white: bool
