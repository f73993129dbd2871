"""What a user should know before believing a number: codes with numbers, and their sentences."""
