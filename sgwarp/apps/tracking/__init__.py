"""Moving scenes: semantics of every frame, fused over time, and what becomes of each object."""
