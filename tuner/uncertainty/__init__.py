"""Uncertainty of each coefficient: standard errors, identifiability, sensitivity, verdicts."""
