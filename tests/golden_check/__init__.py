"""Hold sim_jax against numbers that the original C++ computed.

``python -m tests.golden_check DIR`` compares a folder of golden files with what sim_jax gives for
the same inputs, prints a table and exits 1 if anything is out of tolerance.
"""
