"""Result codes: one list in two languages, and messages that say what is allowed."""

import re
from pathlib import Path

import pytest

from magic_core.errors import Code, MagicError

INTERFACE = Path(__file__).parents[2] / "magic_interfaces" / "msg" / "ResultCode.msg"


def test_codes_equal_the_interface():
    constants = dict(re.findall(r"^uint16 (\w+)=(\d+)$", INTERFACE.read_text(), re.MULTILINE))
    assert {name: int(value) for name, value in constants.items()} == {c.name: c.value for c in Code}


def test_codes_lie_in_their_blocks():
    assert len({c.value for c in Code}) == len(Code)
    assert all(c == 0 or 100 <= c < 600 for c in Code)


@pytest.mark.parametrize(
    "arguments, text",
    [
        (("size", 3, "at least 4"), "size: 3 (allowed: at least 4)"),
        (("encoding", "bayer", ("rgb8", "bgr8")), "encoding: 'bayer' (allowed: rgb8, bgr8)"),
        (("object id", "x", []), "object id: 'x' (allowed: none)"),
        (("plain",), "plain"),
        (("value", ""), "value: ''"),
    ],
)
def test_messages(arguments, text):
    error = MagicError(Code.BAD_REQUEST, *arguments)
    assert error.message == text
    assert str(error) == f"[506 BAD_REQUEST] {text}"


def test_a_number_that_is_no_code_is_refused():
    with pytest.raises(ValueError, match="7"):
        MagicError(7, "what")


def test_long_values_are_cut_in_messages():
    error = MagicError(Code.UNKNOWN_STRATEGY, "strategy", "x" * 5000, "another")
    assert len(error.message) < 400 and "5000 characters" in error.message and "another" in error.message
