"""Forces and moments by regression on recorded accelerations, before anything is simulated.

Recorded accelerations equal those of the model's forces and moments at the recorded motion and
rotor speeds, but for the equation error (Klein and Morelli, Aircraft System Identification, 2006,
chapter 5). No flight is simulated: it takes seconds and cannot diverge.
"""
