"""One tuning job from inputs to result folder: check, search, validate, write."""
