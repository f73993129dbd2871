"""Forces and moments on the vehicle, one pure function each."""
