"""Filter error: coefficients and disturbances estimated together by an extended Kalman filter.

Output error, simulated minus recorded, is efficient where residuals are measurement noise. Gusts,
which the closed loop turns into a slow wander of all signals, bias its estimates. Here a Kalman
filter corrects the simulation by recorded samples, and the coefficients are those with the best
one-step predictions. Source: Jategaonkar, "Flight vehicle
system identification", 2nd ed. 2015, ch. 5; Ljung, "System identification", 1999, ch. 7 and 13
(direct identification in closed loop, consistent with a noise model that holds).
"""
