"""Filter error: coefficients and disturbances estimated together by an extended Kalman filter.

Output error, simulated minus recorded, is efficient where measurement noise alone is left over. A
gust that the closed loop turns into a slow wander of all signals moves its estimates. Here the
simulation is corrected by what was recorded as a Kalman filter would, and the coefficients are
those that predict every sample best from the ones before. Source: Jategaonkar, "Flight vehicle
system identification", 2nd ed. 2015, ch. 5; Ljung, "System identification", 1999, ch. 7 and 13
(direct identification in closed loop, consistent with a noise model that holds).
"""
