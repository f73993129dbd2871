"""The loss of a fit: flights as arrays, residuals, normal equations, Fisher information."""
