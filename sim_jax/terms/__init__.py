"""What pushes and turns the vehicle: one pure function for each force or moment."""
