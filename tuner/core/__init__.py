"""What every room needs: errors, files, YAML, findings, numerics, the time that stages take."""
