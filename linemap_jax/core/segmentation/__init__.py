"""Section 4.3: which points belong to one line.

Two ways:

  incremental     the paper's three criteria, one pass over the points
  optimal         the runs whose lines explain the scan best, with `polyline`, which searches them
"""
