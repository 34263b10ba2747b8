"""A writer of uSD logs, record by record with `struct`, and random logs."""

import struct
import zlib

from hypothesis import strategies as st

BITS = {"b": 8, "h": 16, "i": 32, "l": 32, "q": 64}
CLOCKS = {1: "I", 2: "Q"}


def seal(content):
    """The content with its checksum."""
    return content + struct.pack("<I", zlib.crc32(content))


def header(kinds, *, version=2):
    """kinds: (id, name, [(variable, type character), ...])."""
    parts = [struct.pack("<BHH", 0xBC, version, len(kinds))]
    for event, name, variables in kinds:
        parts.append(struct.pack("<H", event) + name.encode() + b"\0")
        parts.append(struct.pack("<H", len(variables)))
        parts += [f"{variable}({letter})".encode() + b"\0" for variable, letter in variables]
    return b"".join(parts)


def records(kinds, events, *, version=2):
    """The bytes of each record; events: (id, ticks, [values])."""
    letters = {event: "".join(c for _, c in variables) for event, _, variables in kinds}
    return [
        struct.pack(f"<H{CLOCKS[version]}{letters[event]}", event, ticks, *values)
        for event, ticks, values in events
    ]


def usd_log(kinds, events=(), *, version=2):
    body = b"".join(records(kinds, events, version=version))
    return seal(header(kinds, version=version) + body)


def value_of(letter):
    if letter in "efd":
        return st.floats(width={"e": 16, "f": 32, "d": 64}[letter])
    bits = BITS[letter.lower()]
    if letter.isupper():
        return st.integers(0, 2**bits - 1)
    return st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)


@st.composite
def logs(draw):
    """(kinds, events, version)"""
    version = draw(st.sampled_from(sorted(CLOCKS)))
    variables = st.lists(
        st.tuples(names, st.sampled_from("bBhHiIlLqQefd")), max_size=6, unique_by=lambda v: v[0]
    )
    kinds = draw(
        st.lists(
            st.tuples(st.integers(0, 2**16 - 1), names, variables),
            max_size=4,
            unique_by=(lambda kind: kind[0], lambda kind: kind[1]),
        )
    )
    event = st.sampled_from(kinds).flatmap(
        lambda kind: st.tuples(
            st.just(kind[0]),
            value_of(CLOCKS[version]),
            st.tuples(*(value_of(letter) for _, letter in kind[2])),
        )
    )
    return kinds, draw(st.lists(event, max_size=12)) if kinds else [], version
