"""Findings of a run: codes with numbers, and their sentences and remedies."""
