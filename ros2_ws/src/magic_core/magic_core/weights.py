"""Loading networks from a hub or a local folder: whatever goes wrong is one answer with a code."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from magic_core.errors import Code, MagicError


@contextmanager
def loading(weights: str, device: str, allowed: str) -> Iterator[None]:
    """Raises FEATURE_WEIGHTS for whatever the libraries make of files that are not what they should be, of a hub out of reach, or of a
    device that is not there; a MagicError passes as it is.  allowed: what would have done."""
    try:
        yield
    except MagicError:
        raise
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise MagicError(Code.FEATURE_WEIGHTS, f"weights {weights} on {device}: {reason}", None, allowed) from error


def config_of(weights: str, models: Collection[str]) -> Any:
    """The configuration of a transformers model; raises FEATURE_WEIGHTS where it is none of those types."""
    from transformers import AutoConfig

    config = AutoConfig.from_pretrained(weights)
    if config.model_type not in models:
        raise MagicError(Code.FEATURE_WEIGHTS, f"model type of {weights}", config.model_type, models)
    return config
