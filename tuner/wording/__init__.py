"""The sentences of pages and terminals, made of typed results when they are rendered."""
