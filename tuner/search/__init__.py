"""Each search takes an objective and returns a result: Levenberg-Marquardt, CMA-ES, multi-start."""
