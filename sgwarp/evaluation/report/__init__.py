"""The report: error against run time, and stability at the extremes."""
