"""Long runs: progress, log, interruption, random numbers."""
