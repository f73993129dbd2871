"""What measures speed: each module hands back a table, `python -m benchmarks` writes them all."""
