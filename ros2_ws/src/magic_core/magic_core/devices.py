"""Where a network runs."""

from __future__ import annotations

#: The device that is meant where none is named.
AUTO = "auto"


def chosen(device: str) -> str:
    """The torch device for a name: ``auto`` is ``cuda`` where PyTorch sees a GPU, else ``cpu``; any other name is taken as it is.

    Half precision follows from the device, where a network may use it: float16 beside the CPU, float32 on it.
    """
    if device != AUTO:
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"
