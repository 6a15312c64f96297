"""Processes that simulate rollouts beside this one."""

from __future__ import annotations

from magic_core.workers import Workers


def simulating(count: int) -> Workers:
    """So many processes (0: none), each with the physics engine loaded."""
    return Workers(count, _ready)


def _ready() -> None:
    import magic_verifier.verification  # noqa: F401
    from magic_verifier.articulation import panda, prepare
    from magic_verifier.simulation import engine

    engine()
    prepare(panda())
