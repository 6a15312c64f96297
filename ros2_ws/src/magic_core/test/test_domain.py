"""Which ROS domains count as free."""

import socket

import pytest

from magic_core import domain


@pytest.mark.parametrize("port", [domain.ports(50)[10], domain.ports(50)[71], domain.ports(50)[249]])
def test_a_domain_is_taken_by_any_of_its_ports(port):
    number = next(n for n in domain.SAFE if domain.is_free(n))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("0.0.0.0", port + domain.PORTS * (number - 50)))
        assert not domain.is_free(number)
    assert domain.is_free(number)


def test_what_is_drawn_is_drawn_by_nobody_else_for_a_while():
    drawn = [domain.free_domain() for _ in range(15)]
    assert len(set(drawn)) == 15
    assert not any(domain.is_free(number) for number in drawn)


def test_what_is_drawn_for_good_is_nobody_elses_however_many_are_drawn_later():
    mine = domain.free_domain(for_good=True)
    try:
        assert mine not in {domain.free_domain() for _ in range(60)}
        assert not domain.is_free(mine)
    finally:
        domain._kept.pop().close()


def test_ports_are_those_of_the_standard():
    # RTPS 2.2, 9.6.1.1: multicast discovery at 7400 + 250 d, unicast discovery of participant p at 7410 + 250 d + 2 p.
    assert domain.ports(0)[0] == 7400
    assert domain.ports(3)[10] == 7410 + 750
    assert domain.ports(domain.SAFE[-1])[110] < 32768  # below Linux's ephemeral ports, for all participants that there will be


def test_what_a_killed_process_left_is_avoided(tmp_path, monkeypatch):
    monkeypatch.setattr(domain, "SHARED_MEMORY", tmp_path)
    for number in domain.SAFE:
        if number not in (40, 41):
            (tmp_path / f"fastrtps_port{domain.ports(number)[11]}").touch()
    (tmp_path / "fastrtps_port7000").touch()  # of no domain
    (tmp_path / "fastrtps_0a4d6975d272e425").touch()
    assert domain.unclean() >= set(domain.SAFE) - {40, 41}
    monkeypatch.setattr(domain, "is_free", lambda number: True)
    monkeypatch.setattr(domain, "_hold", lambda number, for_good: True)
    assert {domain.free_domain() for _ in range(30)} == {40, 41}
    monkeypatch.setattr(domain, "is_free", lambda number: number not in (40, 41))
    assert domain.free_domain() in set(domain.SAFE) - {40, 41}


def test_no_domain_left(monkeypatch):
    monkeypatch.setattr(domain, "is_free", lambda number: False)
    with pytest.raises(RuntimeError, match="1 to 101"):
        domain.free_domain()
