"""Errors, files, YAML, findings, numerics, phrases and the times of stages."""
