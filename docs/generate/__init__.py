"""Reference pages that follow from the code: ``python -m docs.generate`` writes them again."""
