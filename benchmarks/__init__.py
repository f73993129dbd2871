"""Benchmarks: each module returns a table, `python -m benchmarks` writes them all."""
