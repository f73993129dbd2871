"""Open-loop predictions of recorded flights: from the recorded state, nothing fitted to them."""
