"""A tuning service as its users reach it: from Python and from the command line."""
