"""What recordings say of each coefficient: uncertainty and sensitivity together, as data."""
