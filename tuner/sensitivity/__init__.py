"""What each coefficient does to each signal: locally by Jacobians, globally by Morris and Sobol."""
