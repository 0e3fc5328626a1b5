"""How long work behaves: progress, log, interruption, random numbers."""
