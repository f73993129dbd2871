"""Search for the coefficients of least loss: Levenberg-Marquardt, CMA-ES, growing horizons."""
