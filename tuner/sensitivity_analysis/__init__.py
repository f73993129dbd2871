"""Effect of each coefficient on each signal: local by Jacobians, global by Morris or Sobol."""
