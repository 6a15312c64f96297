"""A ROS domain of one's own."""

from __future__ import annotations

import os
import random
import socket

#: Domains whose ports lie below Linux's ephemeral ports (REP of ROS 2: 0 to 101).
SAFE = range(1, 102)


def port(domain: int, participant: int = 0) -> int:
    """The unicast discovery port of a participant (RTPS 2.2, 9.6.1.1: 7400 + 250 d + 10 + 2 p)."""
    return 7400 + 250 * domain + 10 + 2 * participant


def is_free(domain: int) -> bool:
    """Whether no participant of this machine has taken the domain's first places."""
    for participant in range(2):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            try:
                sock.bind(("0.0.0.0", port(domain, participant)))
            except OSError:
                return False
    return True


def free_domain(exclude: tuple[int, ...] = ()) -> int:
    """A domain in which nobody on this machine is at work, drawn at random so that neighbours starting now differ."""
    domains = [d for d in SAFE if d not in exclude]
    random.SystemRandom().shuffle(domains)
    for domain in domains:
        if is_free(domain):
            return domain
    raise RuntimeError(f"no free ROS domain among {SAFE.start} to {SAFE.stop - 1}")


def isolated(domain: int | None = None) -> dict[str, str]:
    """The process's environment with a domain of its own and discovery on this machine only."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_domain() if domain is None else domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RCUTILS_COLORIZED_OUTPUT": "0",
        "PYTHONUNBUFFERED": "1",
    }
