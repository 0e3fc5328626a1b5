"""An earlier import path of two functions of `sgwarp.reconstruction.fitting`, kept for scripts that use it."""
