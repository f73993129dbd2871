"""Selection of terms beyond the base model, by their predictions of held-out flights."""
