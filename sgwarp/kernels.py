"""Bridge to the device code: `from sgwarp.kernels import projection` works from a wheel and from a checkout.

In a wheel the kernels lie in `sgwarp/kernels/`, in a checkout in `kernels/` beside the package. That folder has no
`__init__.py` (the name `kernels` on PyPI belongs to somebody else), so this module lends it a package identity.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

_here = Path(__file__).resolve().parent
_candidates = (_here / "kernels", _here.parent / "kernels")
__path__ = [str(folder) for folder in _candidates if (folder / "gaussian.py").is_file()][:1]
if not __path__:
    raise ImportError(f"sgwarp: the kernel sources are missing; looked in {', '.join(map(str, _candidates))}")

if TYPE_CHECKING:  # a type checker cannot follow __path__

    def __getattr__(name: str) -> Any: ...
