"""Maps of line segments and circles from 2D range scans, with covariances that can be believed."""
