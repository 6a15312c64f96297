"""Makes the tests' own helpers importable, and the package under test under its name."""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

# pytest's importlib mode names tests after their folders and so takes magic_verifier/, the
# folder, for magic_verifier, the package in it.  Give the name back.
_shadow = sys.modules.get("magic_verifier")
if _shadow is not None and getattr(_shadow, "__file__", None) is None:
    del sys.modules["magic_verifier"]
    importlib.import_module("magic_verifier")
