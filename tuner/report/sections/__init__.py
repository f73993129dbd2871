"""The page's sections, each of a part of the result folder; None for a part that is lacking."""
