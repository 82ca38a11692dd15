"""The learned models that are known, where to get them, and where they lie."""
