"""The service as pages in a browser: rendered here, one small script, nothing from elsewhere."""
