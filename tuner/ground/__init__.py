"""Ground measurements: what test rigs, weighed hovers and propeller tables say of coefficients."""
