"""Which terms beyond the base model a fit holds: by what they predict of flights left out."""
