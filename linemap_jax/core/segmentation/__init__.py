"""Section 4.3: which points belong to one line."""
