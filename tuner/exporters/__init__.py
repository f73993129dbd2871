"""The best-fit coefficients into the formats that simulators and autopilots read."""
