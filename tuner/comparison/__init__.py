"""Simulated compared with recorded for given coefficients: nothing is fitted here."""
