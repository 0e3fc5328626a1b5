"""The files beside this one import each other; importlib mode puts no folder of tests on sys.path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
