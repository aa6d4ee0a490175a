"""One file of a ROS 2 bag, sqlite3 or MCAP, maybe compressed as a whole."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from conversion.messages.recordings import Message
from conversion.ros.bag_files import SQLITE, ZSTD, kind_of
from conversion.ros.bag_mcap import McapBag
from conversion.ros.bag_sqlite import SqliteBag
from conversion.ros.compression import decompress_file
from conversion.ros.definitions import Connection
from conversion.temporary import temporary_folder


class Rosbag2:
    """A ``.db3`` or ``.mcap``, or either with ``.zstd`` behind, open for reading.

    Raises
    ------
    Exception
        If it cannot be read; the libraries beneath raise many kinds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        try:
            plain = path
            if kind_of(path) == ZSTD:
                folder = self._stack.enter_context(TemporaryDirectory(dir=temporary_folder()))
                plain = Path(folder) / "bag"
                decompress_file(path, plain)
            self._storage = SqliteBag(plain) if kind_of(plain) == SQLITE else McapBag(plain)
            self._stack.callback(self._storage.close)
        except BaseException:
            self._stack.close()
            raise
        self.connections = self._storage.connections
        self.start_ns = self._storage.start_ns

    def close(self) -> None:
        """Close the file, and remove what was unpacked."""
        self._stack.close()

    def messages(self, connections: Collection[Connection], start_ns: int) -> Iterator[Message]:
        """Yield the messages of some connections that were recorded at `start_ns` or later.

        Raises
        ------
        Exception
            If the file is damaged; the libraries beneath raise many kinds.
        """
        return self._storage.messages(connections, start_ns)
