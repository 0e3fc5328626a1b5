"""What is left out against what it saves: error against run time, and stability at the extremes."""
