"""The interactive view in the browser."""
