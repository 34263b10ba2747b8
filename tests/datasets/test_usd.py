"""uSD logs: every value back, and one clear error for anything that is not a whole log."""

import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.datasets.usd_files import header, logs, records, seal, usd_log
from trajlearn.datasets.usd import read_usd_log
from trajlearn.exceptions import UnknownFileError

KINDS = [
    (0xFFFF, "fixedFrequency", [("stateEstimate.x", "f"), ("pm.vbatMV", "H")]),
    (0, "estPosition", [("source", "B")]),
    (3, "idle", []),
]
EVENTS = [
    (0xFFFF, 1_000_000, (0.25, 4100)),
    (0, 1_000_500, (7,)),
    (0xFFFF, 1_004_000, (0.5, 4099)),
    (3, 1_005_000, ()),
]


@pytest.fixture(scope="module")
def put(tmp_path_factory):
    path = tmp_path_factory.mktemp("usd") / "log00"

    def write(content):
        path.write_bytes(content)
        return path

    return write


def test_times_are_seconds_of_one_clock_and_variables_keep_names_and_types(put):
    log = read_usd_log(put(usd_log(KINDS, EVENTS)))
    assert list(log) == ["fixedFrequency", "estPosition", "idle"]
    fixed = log["fixedFrequency"]
    np.testing.assert_array_equal(fixed.times, [1.0, 1.004])
    assert list(fixed.variables) == ["stateEstimate.x", "pm.vbatMV"]
    np.testing.assert_array_equal(fixed.variables["stateEstimate.x"], np.float32([0.25, 0.5]))
    np.testing.assert_array_equal(fixed.variables["pm.vbatMV"], [4100, 4099])
    assert [values.dtype for values in fixed.variables.values()] == [np.float32, np.uint16]
    np.testing.assert_array_equal(log["estPosition"].times, [1.0005])
    np.testing.assert_array_equal(log["estPosition"].variables["source"], [7])
    assert len(log["idle"]) == 1
    assert log["idle"].variables == {}


def test_a_type_without_records_is_there_and_empty(put):
    log = read_usd_log(put(usd_log(KINDS, EVENTS[:1])))
    assert len(log["estPosition"]) == 0
    assert log["estPosition"].variables["source"].dtype == np.uint8
    assert read_usd_log(put(usd_log([]))) == {}
    longer_than_the_file = [(0, "e", [(letter, "d") for letter in "abcdefgh"])]
    assert len(read_usd_log(put(usd_log(longer_than_the_file)))["e"]) == 0


def test_version_one_counts_milliseconds(put):
    log = read_usd_log(put(usd_log(KINDS, [(3, 1500, ())], version=1)))
    np.testing.assert_array_equal(log["idle"].times, [1.5])


@given(logs())
def test_every_value_comes_back(put, written):
    kinds, events, version = written
    log = read_usd_log(put(usd_log(kinds, events, version=version)))
    assert list(log) == [name for _, name, _ in kinds]
    for event, name, variables in kinds:
        own = [(ticks, values) for other, ticks, values in events if other == event]
        seconds = [ticks / (1e3 if version == 1 else 1e6) for ticks, _ in own]
        np.testing.assert_array_equal(log[name].times, np.array(seconds, dtype=float))
        assert list(log[name].variables) == [variable for variable, _ in variables]
        for i, (variable, letter) in enumerate(variables):
            got = log[name].variables[variable]
            assert got.shape == (len(own),)
            assert got.dtype.itemsize == struct.calcsize(f"<{letter}")
            np.testing.assert_array_equal(got, [values[i] for _, values in own])


def test_a_log_cut_at_any_byte_is_refused(put):
    content = usd_log(KINDS, EVENTS)
    for length in range(len(content)):
        with pytest.raises(UnknownFileError, match=r"log00, byte \d+: .+\. .+\."):
            read_usd_log(put(content[:length]))


# Its records hold zeros, and 0 is an id: after a wrong id, records seem to go on.
ZEROS = [(0, "a", [("v", "q"), ("w", "f")]), (1, "b", [("v", "f")]), (2, "c", [])]
ZERO_EVENTS = [(i % 3, 10_000_000 + 4000 * i, [(0, 1), (1,), ()][i % 3]) for i in range(12)]


@pytest.mark.parametrize(
    ("content", "allow"),
    [
        (usd_log(KINDS, EVENTS), False),
        (usd_log(KINDS, EVENTS), True),
        (usd_log(ZEROS, ZERO_EVENTS), True),
        (usd_log(ZEROS, ZERO_EVENTS[:-1], version=1), True),
        (usd_log(ZEROS, ZERO_EVENTS[::3] + ZERO_EVENTS[1:2]), True),
    ],
    ids=["strict", "plain", "zeros", "version 1", "rare last"],
)
def test_one_wrong_bit_anywhere_is_refused(put, content, allow):
    path = put(content)
    with path.open("r+b", buffering=0) as handle:
        for bit in range(8 * len(content)):
            place = bit // 8
            handle.seek(place)
            handle.write(bytes([content[place] ^ 1 << bit % 8]))
            with pytest.raises(UnknownFileError, match=r"log00, byte \d+: "):
                read_usd_log(path, allow_truncated=allow)
            handle.seek(place)
            handle.write(content[place : place + 1])


@pytest.mark.parametrize("tail", [b"\3\0\x88", bytes(40)], ids=["cut", "0"])
def test_damage_before_a_cut_that_leaves_no_records_is_refused(put, tail):
    parts = records(KINDS, EVENTS)
    content = header(KINDS) + b"\5\0" + b"".join(parts)[2:] + tail
    message = rf"byte {len(header(KINDS))}: .*no event with the id 5, and \d+ bytes follow: "
    with pytest.raises(UnknownFileError, match=message):
        read_usd_log(put(content), allow_truncated=True)


def test_many_wrong_bits_in_a_whole_log_are_refused(put):
    content, damaged = usd_log(KINDS, EVENTS), bytearray(usd_log(KINDS, EVENTS))
    damaged[-30:-4] = b"".join(records(KINDS, EVENTS))[-26:-10] + damaged[-14:-4]
    damaged[-20:-16] = b"\xff" * 4
    assert len(damaged) == len(content)
    message = "last four bytes are no checksum of them: the log was damaged, not cut off"
    with pytest.raises(UnknownFileError, match=message):
        read_usd_log(put(bytes(damaged)), allow_truncated=True)


@pytest.mark.parametrize(("later", "refused"), [(-2.0, True), (-0.5, False), (3.0e4, True)])
def test_records_of_a_cut_log_whose_times_leap_are_refused(put, later, refused):
    events = [(3, 40_000_000, ()), (0, round((40 + later) * 1e6), (7,)), (3, 41_000_000, ())]
    path = put(header(KINDS) + b"".join(records(KINDS, events)) + b"\3\0\x88")
    if refused:
        with pytest.raises(UnknownFileError, match=r"byte \d+: the time leaps by .* damaged"):
            read_usd_log(path, allow_truncated=True)
    else:
        with pytest.warns(UserWarning, match="reading the 3 records"):
            read_usd_log(path, allow_truncated=True)


# A prefix and a valid checksum let the random bytes reach the header and the records.
@settings(max_examples=300)
@given(
    prefix=st.sampled_from([b"", b"\xbc\2\0", b"\xbc\2\0\1\0", header(KINDS)]),
    noise=st.binary(max_size=120),
    sealed=st.booleans(),
    allow=st.booleans(),
)
@example(prefix=header(KINDS), noise=b"\0", sealed=True, allow=False)
def test_random_bytes_are_read_or_refused(put, prefix, noise, sealed, allow):
    content = prefix + noise
    path = put(seal(content) if sealed else content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            log = read_usd_log(path, allow_truncated=allow)
        except UnknownFileError:
            return
    assert sum(map(len, log.values())) <= len(noise)


ONE = struct.pack("<BHHH", 0xBC, 2, 1, 0)
LYING = {
    "types": (struct.pack("<BHH", 0xBC, 2, 65535), "ends in its header"),
    "variables": (ONE + b"e\0\xff\xff", "a name in the header has no end"),
    "long name": (ONE + b"e" * 100_000, "a name in the header has no end"),
    "long variable": (ONE + b"e\0\1\0" + b"v" * 100_000 + b"(s)\0", r"vv\.\.\.v.* type c"),
    "long event": (ONE + b"e" * 100_000 + b"\0\1\0v(s)\0", r"ee\.\.\.e.* type c"),
}


@pytest.mark.parametrize("allow", [False, True])
@pytest.mark.parametrize("kind", LYING)
def test_a_header_that_promises_more_than_there_is_takes_no_memory(put, kind, allow):
    content, match = LYING[kind]
    path = put(seal(content))
    tracemalloc.start()
    with pytest.raises(UnknownFileError, match=match) as error:
        read_usd_log(path, allow_truncated=allow)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_500_000
    assert len(str(error.value)) < 1000


def test_a_long_log_takes_a_small_multiple_of_its_size(put):
    content = usd_log(KINDS, EVENTS * 20_000)
    path = put(content)
    tracemalloc.start()
    log = read_usd_log(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(log["fixedFrequency"]) == 40_000
    assert peak < 5 * len(content)


def test_a_large_file_of_another_kind_is_not_read(tmp_path):
    path = tmp_path / "video"
    with path.open("wb") as handle:
        handle.truncate(2**36)  # a hole: no disk is used
    with pytest.raises(UnknownFileError, match=r"byte 0: this is not a uSD log.*Pass a file"):
        read_usd_log(path)


def one(*variables):
    return [(0, "event", [*variables])]


@pytest.mark.parametrize(
    ("content", "match"),
    [
        pytest.param(usd_log([], version=3), "byte 1: .*version 3.*reads", id="version"),
        pytest.param(usd_log(one(("v", "s"))), r"byte 15: .*'v\(s\)'.*event.*types?", id="type"),
        pytest.param(usd_log(one(("v", "?"))), r"byte 15: .*'v\(\?\)'", id="bool"),
        pytest.param(seal(header([(0, "e", [])])[:-2] + b"\1\0f\0"), "byte 11: .*'f'", id="bare"),
        pytest.param(seal(ONE + b"e\0\1\0v[f]\0"), r"byte 11: .*'v\[f\]'", id="brackets"),
        pytest.param(usd_log(one(("v", "f"), ("v", "B"))), "byte 20: .*'v' twice", id="variable"),
        pytest.param(usd_log([(0, "a", []), (0, "b", [])]), "byte 11: .*'b'.*id 0", id="id"),
        pytest.param(usd_log([(0, "a", []), (1, "a", [])]), "byte 11: .*'a'.*id 1", id="name"),
        pytest.param(seal(header(KINDS) + b"\5\0"), "no event with the id 5", id="unknown id"),
        pytest.param(seal(header(KINDS) + b"\0\0\1"), "last record is not whole", id="overhang"),
        pytest.param(seal(header(KINDS) + b"\0"), "last record is not whole", id="one byte"),
        pytest.param(
            seal(struct.pack("<BHHH", 0xBC, 2, 1, 0) + b"\xff\0\0\0"), "byte 7: .*UTF-8", id="UTF-8"
        ),
    ],
)
@pytest.mark.parametrize("allow", [False, True])
def test_a_sealed_file_that_breaks_the_format_is_refused(put, content, match, allow):
    with pytest.raises(UnknownFileError, match=match):
        read_usd_log(put(content), allow_truncated=allow)


@pytest.mark.parametrize("tail", [b"\3\0\x88", bytes(40), bytes(4)], ids=["cut", "0", "four 0"])
def test_the_whole_records_of_a_cut_log_can_be_read(put, tail):
    content = header(KINDS) + b"".join(records(KINDS, EVENTS)[:3])
    stop = len(content)
    path = put(content + tail)
    with pytest.raises(UnknownFileError, match="allow_truncated=True"):
        read_usd_log(path)
    with pytest.warns(UserWarning, match=f"reading the 3 records up to byte {stop} "):
        log = read_usd_log(path, allow_truncated=True)
    np.testing.assert_array_equal(log["fixedFrequency"].variables["pm.vbatMV"], [4100, 4099])
    assert len(log["idle"]) == 0


def test_a_log_cut_anywhere_after_its_header_yields_the_records_before(put):
    parts = records(KINDS, EVENTS)
    content = header(KINDS) + b"".join(parts)
    ends = np.cumsum([len(header(KINDS)), *map(len, parts)])
    for length in range(ends[0], len(content)):
        if length - 4 in ends:
            # No one knows whether the four bytes were to be a checksum.
            with pytest.raises(UnknownFileError, match="damaged, not cut off"):
                read_usd_log(put(content[:length]), allow_truncated=True)
            continue
        with pytest.warns(UserWarning, match="no valid checksum"):
            log = read_usd_log(put(content[:length]), allow_truncated=True)
        # A record that ends in zeros may be taken for zeros of the card: one at most.
        assert np.searchsorted(ends, length, side="right") - 1 - sum(map(len, log.values())) in (
            0,
            content[length - 1] == 0,
        )


def test_a_whole_log_reads_the_same_and_without_a_warning(put):
    path = put(usd_log(KINDS, EVENTS))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = read_usd_log(path, allow_truncated=True)
    assert [len(events) for events in log.values()] == [2, 1, 1]


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_usd_log(tmp_path / "log99")
