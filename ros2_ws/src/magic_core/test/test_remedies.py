"""Every code has a meaning and a remedy, in sentences."""

from magic_core.errors import Code
from magic_core.remedies import REMEDIES


def test_every_code_has_its_remedy_in_order():
    assert list(REMEDIES) == list(Code)
    for remedy in REMEDIES.values():
        for text in remedy:
            assert text[0] in "`" or text[0].isalnum()
            assert text.endswith((".", "`"))
    assert len({r.meaning for r in REMEDIES.values()}) == len(Code)
