"""Parts of `sgwarp.fit`: photographs, starting points, the model, strategies, checkpoints, pictures."""
