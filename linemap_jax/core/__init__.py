"""The method: pure functions on arrays; no files, no printing."""
