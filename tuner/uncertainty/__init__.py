"""What the flights say about each coefficient: how much, how surely, confused with what."""

from tuner.uncertainty.estimates import Estimate, Uncertainty, uncertainty
from tuner.uncertainty.verdict import Verdict

__all__ = ["Estimate", "Uncertainty", "Verdict", "uncertainty"]
