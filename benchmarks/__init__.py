"""What measures speed: each module prints a table, `python -m benchmarks` all of them."""
