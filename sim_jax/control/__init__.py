"""The controllers that flew: geometric position and attitude, PX4 rate PID and mixer."""
