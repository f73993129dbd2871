"""Where simulation meets data: flights as arrays, residuals, normal equations, the RMSE table."""
