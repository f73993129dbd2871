"""What the flights say about each coefficient: how much, how surely, confused with what."""
