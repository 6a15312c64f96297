"""A ROS domain of one's own."""

from __future__ import annotations

import os
import random
import socket
from collections import deque
from pathlib import Path

#: Domains whose ports lie below Linux's ephemeral ports (REP of ROS 2: 0 to 101).
SAFE = range(1, 102)

#: The first port of domain 0, and how many a domain has (RTPS 2.2, 9.6.1.1).
FIRST_PORT, PORTS = 7400, 250

#: The last port of each domain that this process drew last: no participant comes so far, and other processes see that it is taken.
_held: deque[socket.socket] = deque(maxlen=20)
#: The same of those that it drew for good.
_kept: list[socket.socket] = []

#: Where Fast DDS keeps its shared memory.
SHARED_MEMORY = Path("/dev/shm")


def ports(domain: int) -> range:
    """The UDP ports of a domain (RTPS 2.2, 9.6.1.1): each participant takes two of them, the first free ones."""
    return range(FIRST_PORT + PORTS * domain, FIRST_PORT + PORTS * (domain + 1))


def is_free(domain: int) -> bool:
    """Whether no participant of this machine holds a port of the domain, be it the last of many that has been left behind."""
    for port in ports(domain):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            try:
                sock.bind(("0.0.0.0", port))
            except OSError:
                return False
    return True


def unclean() -> set[int]:
    """The domains of which shared memory still holds something.

    Fast DDS names its shared memory ports after the UDP ports.  What a killed process leaves of them is
    not always recovered by the next one, which then hears nothing (Fast DDS issues 3535, 5469).
    """
    names = (path.name.removeprefix("fastrtps_port") for path in SHARED_MEMORY.glob("fastrtps_port*"))
    return {(int(name) - FIRST_PORT) // PORTS for name in names if name.isdigit()}


def free_domain(exclude: tuple[int, ...] = (), for_good: bool = False) -> int:
    """A domain in which nobody on this machine is at work, and which nobody else has drawn just now.

    Domains that a killed process has left something of are taken only where there are no others.  One drawn ``for_good`` is this
    process's as long as it lives, however many it draws later and whether or not somebody is at work in it.
    """
    domains = [d for d in SAFE if d not in exclude]
    random.SystemRandom().shuffle(domains)
    domains.sort(key=unclean().__contains__)
    for domain in domains:
        if is_free(domain) and _hold(domain, for_good):
            return domain
    raise RuntimeError(f"no free ROS domain among {SAFE.start} to {SAFE.stop - 1}")


def _hold(domain: int, for_good: bool) -> bool:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind(("0.0.0.0", ports(domain)[-1]))
    except OSError:  # between the look and this, somebody else
        sock.close()
        return False
    if for_good:
        _kept.append(sock)
        return True
    if len(_held) == _held.maxlen:
        _held.popleft().close()
    _held.append(sock)
    return True


def isolated(domain: int | None = None) -> dict[str, str]:
    """The process's environment with a domain of its own and discovery on this machine only."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_domain() if domain is None else domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RCUTILS_COLORIZED_OUTPUT": "0",
        "PYTHONUNBUFFERED": "1",
    }
