"""A service around the simulated flight: recordings in, coefficients and reports out."""
