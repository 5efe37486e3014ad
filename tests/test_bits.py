"""Results keep their bits: the quick cases of `tests/bits.py`, where they were recorded."""

import json

import pytest

import bits

RECORDED = json.loads(bits.RECORD.read_text())


@pytest.mark.skipif(
    bits.versions() != RECORDED["versions"], reason="recorded with other versions, or another processor"
)
@pytest.mark.parametrize("name", bits.QUICK)
def test_bits_are_those_that_were_recorded(name):
    assert bits.bits(name) == RECORDED["bits"][name]


def test_every_case_has_its_bits():
    assert set(RECORDED["bits"]) == set(bits.CASES)
