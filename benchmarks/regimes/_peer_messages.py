"""Arrays through a pipe, between this project and a peer in an environment of its own.

Needs numpy alone, as both sides import it.
"""

from io import BytesIO
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.float64]]


def send(stream: BinaryIO, command: str, arrays: Arrays) -> None:
    """Write one message: its length, then an .npz archive."""
    with BytesIO() as raw:
        np.savez(raw, command=np.array(command), **arrays)
        content = raw.getvalue()
    stream.write(len(content).to_bytes(8, "little") + content)
    stream.flush()


def receive(stream: BinaryIO) -> tuple[str, Arrays] | None:
    """Read one message; None at the end of the stream."""
    head = stream.read(8)
    if len(head) < 8:
        return None
    with np.load(BytesIO(stream.read(int.from_bytes(head, "little"))), allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    return str(arrays.pop("command")), arrays
