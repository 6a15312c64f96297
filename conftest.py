"""For pytest: what lets the tests of several packages run in one process."""

from __future__ import annotations

import importlib
import importlib.util
import signal
import sys
from pathlib import Path

import hypothesis
import pytest

# No test may fail because the machine has other work.
hypothesis.settings.register_profile("magic", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("magic")

# A shell that starts the tests in the background has them ignore SIGINT, and what the tests start would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# In importlib mode pytest names a test module after its path, ``magic_planner.test.test_x``, and would make an empty ``magic_planner`` for
# it that hides the installed package. Importing the packages at the repository's root first prevents that.
for manifest in sorted(Path(__file__).parent.glob("*/package.xml")):
    if importlib.util.find_spec(manifest.parent.name) is not None:
        importlib.import_module(manifest.parent.name)


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Each test folder sees its own helper modules: several have a ``scenes.py``, and Python remembers the first by its bare name."""
    if not isinstance(collector, pytest.Module):
        return
    folder = collector.path.parent
    for name, module in list(sys.modules.items()):
        place = Path(getattr(module, "__file__", None) or "/").parent
        if "." not in name and place.name in ("test", "tests") and place != folder:
            del sys.modules[name]
    if str(folder) in sys.path:
        sys.path.remove(str(folder))
    sys.path.insert(0, str(folder))
