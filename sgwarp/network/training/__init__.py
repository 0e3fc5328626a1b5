"""Training of the 3D semantic network on lifted semantics (paper, Sec. III-C)."""

from sgwarp.network.training.trainer import distill as distill
