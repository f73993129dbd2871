"""What the flights say about each coefficient: how much, how surely, confused with what."""

from tuner.identifiability.uncertainty import Estimate, Uncertainty, uncertainty
from tuner.identifiability.verdict import Verdict

__all__ = ["Estimate", "Uncertainty", "Verdict", "uncertainty"]
