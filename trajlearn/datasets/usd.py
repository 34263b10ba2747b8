"""Binary logs that a Crazyflie writes to its micro-SD card deck.

The layout, little endian: the byte 0xBC, the version of the format and the number of event types;
for each type its id, its name and the variables, as ``name(c)`` with the type character `c` of
Python's `struct`; then the records of all types in the order they happened, each an id, a time
and the packed variables; in the last four bytes a CRC-32 of everything before.
"""

import reprlib
import struct
import warnings
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from trajlearn.exceptions import UnknownFileError

__all__ = ["UsdEvents", "read_usd_log"]

_MAGIC, _CRC_BYTES, _PREAMBLE_BYTES = 0xBC, 4, 5
_CRC_POLYNOMIAL = 0xEDB88320
# What one wrong bit may make look like a cut lies near the end of the log.
_SEARCHED_BYTES = 1 << 20
# Tasks of the firmware write side by side, and no battery lasts longer.
_MAX_STEP_BACK_S, _MAX_STEP_S = 1.0, 3600.0
# version of the format -> how a record holds its time, and the ticks in a second
_CLOCKS = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}
# type character -> numpy's name, of the standard sizes: "l" has four bytes
_TYPES = {
    letter: f"<{kind}{struct.calcsize('<' + letter)}"
    for kind, letters in {"i": "bhilq", "u": "BHILQ", "f": "efd"}.items()
    for letter in letters
}


@dataclass(frozen=True, eq=False)
class UsdEvents:
    """The n records of one type of event in a uSD log.

    Attributes
    ----------
    times : ndarray of shape (n,)
        Seconds on the vehicle's clock, which starts with its processor: the same clock for every
        type of event. In the order of the file.
    variables : dict of str to ndarray of shape (n,)
        By the names of the log, such as ``"stateEstimate.x"``, in the units and the types
        that the firmware logged them in.
    """

    times: np.ndarray
    variables: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.times)


def read_usd_log(path: str | Path, *, allow_truncated: bool = False) -> dict[str, UsdEvents]:
    r"""Read a log of the Crazyflie's micro-SD card deck.

    Parameters
    ----------
    path : str or Path
    allow_truncated : bool, default=False
        A log has no checksum where the power went before logging was stopped. With True, the
        whole records of a log that ends within a record, or in zeros, are returned with a
        warning. A log that is damaged otherwise is refused all the same: one that whole records
        fill up to four bytes that are no checksum of them, that goes on after an unknown event,
        whose times leap, or that a single bit makes whole. Damage of several bits within the last
        records may still pass for a cut.

    Returns
    -------
    dict of str to UsdEvents
        By name of the event (``"fixedFrequency"`` for variables logged at a fixed rate), in
        the order of the file's header; a type without records is there, empty.

    Raises
    ------
    UnknownFileError
        If the file is of another kind, cut off or damaged; the message gives the byte.
    OSError
        If it is not there or cannot be opened.

    Examples
    --------
    >>> import struct, tempfile, zlib
    >>> header = struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"battery\0" + struct.pack("<H", 1)
    >>> records = struct.pack("<HQf", 7, 1_500_000, 3.75) + struct.pack("<HQf", 7, 2_500_000, 3.5)
    >>> content = header + b"pm.vbat(f)\0" + records
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "log00"
    ...     _ = path.write_bytes(content + struct.pack("<I", zlib.crc32(content)))
    ...     log = read_usd_log(path)
    >>> log["battery"].times, log["battery"].variables["pm.vbat"]
    (array([1.5, 2.5]), array([3.75, 3.5 ], dtype=float32))
    """
    path = Path(path)
    try:
        with path.open("rb") as handle:
            # A large file of another kind is refused by its first bytes.
            preamble = handle.read(_PREAMBLE_BYTES)
            version, n_types = _read_preamble(preamble)
            data = preamble + handle.read()
        return _decode(data, version, n_types, path, allow_truncated)
    except _Malformed as error:
        raise UnknownFileError(f"{path}, byte {error.offset}: {error.problem}") from None


class _Malformed(Exception):
    """What is wrong, and at which byte."""

    def __init__(self, offset: int, problem: str) -> None:
        super().__init__(offset, problem)
        self.offset, self.problem = offset, problem


@dataclass(frozen=True)
class _Kind:
    """A type of event: its name, its variables and the layout of its records."""

    name: str
    variables: list[str]
    dtype: np.dtype


def _read_preamble(data: bytes) -> tuple[int, int]:
    if data[:1] != bytes([_MAGIC]):
        raise _Malformed(
            0,
            f"this is not a uSD log, which begins with the byte {_MAGIC:#x}. Pass a file as it "
            "lies on the card of the Crazyflie.",
        )
    if len(data) < _PREAMBLE_BYTES:
        raise _Malformed(len(data), "the file ends in its header. Copy it from the card again.")
    version, n_types = struct.unpack_from("<HH", data, 1)
    if version not in _CLOCKS:
        raise _Malformed(
            1,
            f"the format has version {version}, this package reads {sorted(_CLOCKS)}. Copy the "
            "file from the card again; if it is the same, a newer package is needed.",
        )
    return version, n_types


def _decode(
    data: bytes, version: int, n_types: int, path: Path, allow_truncated: bool
) -> dict[str, UsdEvents]:
    end = len(data) - _CRC_BYTES
    whole = zlib.crc32(memoryview(data)[:end]) == struct.unpack_from("<I", data, end)[0]
    if not whole and not allow_truncated:
        raise _Malformed(
            end,
            "the checksum is missing or does not match: the log was cut off or damaged. "
            "Copy it from the card again; if the power went while logging, "
            "allow_truncated=True reads the records before that.",
        )
    ticks = _CLOCKS[version][1]
    kinds, start = _read_header(data, end if whole else len(data), version, n_types)
    if whole:
        offsets, stop, problem = _find_records(data, start, end, kinds)
        if problem:
            raise _Malformed(stop, f"{problem}. The logger wrote it so: report the file.")
    else:
        offsets, stop = _find_records_before_cut(data, start, kinds)
    raw = np.frombuffer(data, dtype=np.uint8)
    log = {
        kind.name: _gather(raw, np.asarray(offsets[event]), kind, ticks)
        for event, kind in kinds.items()
    }
    if not whole:
        _check_times(list(offsets.values()), list(log.values()))
        warnings.warn(
            f"{path} has no valid checksum: reading the {sum(map(len, log.values()))} "
            f"records up to byte {stop} and leaving out {len(data) - stop} bytes.",
            stacklevel=3,
        )
    return log


def _read_header(data: bytes, end: int, version: int, n_types: int) -> tuple[dict[int, _Kind], int]:
    """The types of events by id, and where the first record begins."""
    kinds: dict[int, _Kind] = {}
    names: set[str] = set()
    at = _PREAMBLE_BYTES
    for _ in range(n_types):
        event, begin = _read_u16(data, at, end), at
        name, at = _read_text(data, at + 2, end)
        if event in kinds or name in names:
            raise _Malformed(
                begin,
                f"the event {reprlib.repr(name)} with the id {event} repeats the name or the id "
                "of another. Name each event once in the logger's configuration.",
            )
        n_variables, at = _read_u16(data, at, end), at + 2
        variables: dict[str, str] = {}
        for _ in range(n_variables):
            begin = at
            text, at = _read_text(data, at, end)
            variable, letter = text[:-3], text[-2:-1]
            if text[-3:] != f"({letter})" or letter not in _TYPES:
                raise _Malformed(
                    begin,
                    f"the variable {reprlib.repr(text)} of the event {reprlib.repr(name)} does "
                    f"not end in (c) with a type c among {' '.join(_TYPES)}. Report the file.",
                )
            if variable in variables:
                raise _Malformed(
                    begin,
                    f"the event {reprlib.repr(name)} has {reprlib.repr(variable)} twice. Name "
                    "each variable once in the logger's configuration.",
                )
            variables[variable] = _TYPES[letter]
        # Fields are numbered: numpy forbids some of the names that a log allows.
        fields = [("id", "<u2"), ("time", _CLOCKS[version][0])]
        fields += [(str(i), code) for i, code in enumerate(variables.values())]
        kinds[event] = _Kind(name, list(variables), np.dtype(fields))
        names.add(name)
    return kinds, at


def _read_u16(data: bytes, at: int, end: int) -> int:
    if at + 2 > end:
        raise _Malformed(end, "the file ends in its header. Copy it from the card again.")
    return int.from_bytes(data[at : at + 2], "little")


def _read_text(data: bytes, at: int, end: int) -> tuple[str, int]:
    stop = data.find(b"\0", at, end)
    if stop < 0:
        raise _Malformed(at, "a name in the header has no end. Copy the file from the card again.")
    try:
        return data[at:stop].decode(), stop + 1
    except UnicodeDecodeError:
        raise _Malformed(at, "a name in the header is not UTF-8. Report the file.") from None


def _find_records(
    data: bytes, start: int, end: int, kinds: dict[int, _Kind]
) -> tuple[dict[int, "array[int]"], int, str]:
    """Where the records of each type begin, where the last whole one ends, and why it is the last.

    The reason is empty if the records fill the file up to `end`.
    """
    sizes = {event: kind.dtype.itemsize for event, kind in kinds.items()}
    offsets = {event: array("q") for event in kinds}
    append = {event: found.append for event, found in offsets.items()}
    at, last = start, end - 2
    while at <= last:
        event = data[at] | data[at + 1] << 8
        if event not in sizes:
            return offsets, at, f"the header has no event with the id {event}"
        following = at + sizes[event]
        if following > end:
            break
        append[event](at)
        at = following
    return offsets, at, "" if at == end else "the last record is not whole"


def _find_records_before_cut(
    data: bytes, start: int, kinds: dict[int, _Kind]
) -> tuple[dict[int, "array[int]"], int]:
    """The records of a log whose end was lost, and where the last whole one ends.

    What is left of the next record, or zeros, may follow: all else is damage, and what stands
    before it is not to be believed either.
    """
    end = len(data) - _CRC_BYTES
    if not _find_records(data, start, end, kinds)[2] and any(data[end:]):
        raise _Malformed(
            end,
            "whole records fill the file up to here, and the last four bytes are no checksum of "
            "them: the log was damaged, not cut off. Copy it from the card again.",
        )
    # A card may hold zeros where nothing was written, and 0 is a valid id.
    end = len(data.rstrip(b"\0"))
    offsets, stop, problem = _find_records(data, start, end, kinds)
    if stop + 2 <= end and _read_u16(data, stop, end) not in kinds:
        raise _Malformed(
            stop,
            f"{problem}, and {end - stop} bytes follow: the log was damaged, not cut off. Copy it "
            "from the card again.",
        )
    wrong = _find_wrong_bit(data)
    if wrong is not None:
        raise _Malformed(
            wrong,
            "a wrong bit: with the other value the checksum matches. Copy the log from the card "
            "again.",
        )
    return offsets, stop


def _find_wrong_bit(data: bytes) -> int | None:
    """The byte with the one bit that would make the last four bytes the checksum of the rest.

    A CRC is linear: what a wrong bit changes depends on its distance from the end alone.
    """
    end = len(data) - _CRC_BYTES
    found = zlib.crc32(memoryview(data)[:end]) ^ struct.unpack_from("<I", data, end)[0]
    change = 1
    for back in range(8 * min(end, _SEARCHED_BYTES)):
        change = change >> 1 ^ (_CRC_POLYNOMIAL if change & 1 else 0)
        if change == found:
            return end - 1 - back // 8
    return None


def _check_times(offsets: "list[array[int]]", events: list[UsdEvents]) -> None:
    """Records found at a wrong place have times that leap."""
    nothing = np.empty(0)
    places = np.concatenate([nothing, *offsets])
    order = np.argsort(places)
    steps = np.diff(np.concatenate([nothing, *(some.times for some in events)])[order])
    leaps = np.flatnonzero((steps < -_MAX_STEP_BACK_S) | (steps > _MAX_STEP_S))
    if len(leaps):
        raise _Malformed(
            int(places[order][leaps[0] + 1]),
            f"the time leaps by {steps[leaps[0]]:.3g} s: the log was damaged, not cut off. Copy "
            "it from the card again.",
        )


def _gather(raw: np.ndarray, offsets: np.ndarray, kind: _Kind, ticks: float) -> UsdEvents:
    records = np.empty(0, kind.dtype)
    if len(offsets):
        records = sliding_window_view(raw, kind.dtype.itemsize)[offsets].view(kind.dtype)[:, 0]
    # Copies: a view of one variable would keep the whole log in memory.
    values = {
        name: records[str(i)].astype(records[str(i)].dtype.newbyteorder("="))
        for i, name in enumerate(kind.variables)
    }
    return UsdEvents(records["time"] / ticks, values)
