"""Where networks run: the GPU where there is one, and a name that was given as it is."""

from types import SimpleNamespace

import pytest

from magic_core import devices


@pytest.mark.parametrize("there, device", [(True, "cuda"), (False, "cpu")])
def test_auto_is_what_is_there(monkeypatch, there, device):
    torch = SimpleNamespace(cuda=SimpleNamespace(is_available=lambda: there))
    monkeypatch.setitem(__import__("sys").modules, "torch", torch)
    assert devices.chosen(devices.AUTO) == device
    assert devices.chosen("cuda:1") == "cuda:1"
