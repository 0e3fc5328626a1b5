"""The name under which `sgwarp.reconstruction.fitting` was first published; kept for scripts that use it."""
