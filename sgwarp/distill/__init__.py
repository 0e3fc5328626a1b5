"""Training of the 3D semantic network on lifted semantics (paper, Sec. III-C)."""

from sgwarp.distill.train import distill as distill
