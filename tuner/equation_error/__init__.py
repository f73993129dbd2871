"""Forces and moments by regression on recorded accelerations, before anything is simulated.

The accelerations that were recorded are equal to those that the model's forces and moments make of
the recorded motion and rotor speeds, but for an error: that of the equation (Klein and Morelli,
Aircraft System Identification, 2006, chapter 5). No flight is simulated, so that it takes seconds
and nothing can tumble.
"""
