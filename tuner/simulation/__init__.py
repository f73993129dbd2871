"""Flights that nobody flew: any trajectory, vehicle and controller, as tables or recordings."""
