"""The bins and their requests in an SQLite file: :class:`Store`.

A bin is its arguments and a log that only grows: every request that changed the bin is a row, an
undo too. So the rows of a bin, in order, are all that is needed to make it again, and the answer to
a request stays even if it was undone.

The file is in SQLite's write-ahead mode with ``synchronous = FULL``: a commit is on the disk when
it returns, so what was answered survives the end of the program and a loss of power. The file is
locked as long as the store is open.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

APPLICATION = 0x6D706B31
"""The number by which SQLite files of this program are known."""
VERSION = 1
TABLES = """
CREATE TABLE bins (
    number INTEGER PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    opened TEXT NOT NULL,
    arguments TEXT NOT NULL,
    key TEXT UNIQUE,
    digest BLOB,
    answer TEXT NOT NULL
) STRICT;
CREATE TABLE log (
    number INTEGER PRIMARY KEY,
    bin INTEGER NOT NULL REFERENCES bins,
    step INTEGER,
    kind TEXT NOT NULL,
    call TEXT,
    key TEXT,
    digest BLOB,
    answer TEXT NOT NULL,
    UNIQUE (bin, step),
    UNIQUE (bin, key)
) STRICT;
CREATE INDEX closed ON log (bin) WHERE kind = 'close';
"""


class StoreError(OSError):
    """The file cannot be read or written; nothing was changed."""


@dataclass(frozen=True)
class Keyed:
    """The idempotency key of a request, and a digest of the request."""

    key: str
    digest: bytes


@dataclass(frozen=True)
class BinRow:
    """A bin as it is stored."""

    number: int
    id: str
    opened: str  # date and time, UTC
    arguments: str  # JSON
    step: int  # number of changes so far
    closed: bool


@dataclass(frozen=True)
class Entry:
    """A request to a bin that was answered."""

    kind: str
    answer: str  # JSON
    step: int | None = None  # number of the change; None if the bin did not change
    call: str | None = None  # JSON, the packer's call; None if it made none
    keyed: Keyed | None = None


@dataclass
class _Write:
    """A statement that waits for the disk."""

    statement: str
    values: tuple[Any, ...]
    done: bool = False
    error: Exception | None = None


class Store:
    """The file of the bins; every method may be called from any thread.

    Args:
        path: the SQLite file; it is made if it does not exist.

    Raises:
        ValueError: if the file is damaged, belongs to another program, or is in use.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._waiting: deque[_Write] = deque()
        try:
            self._file = sqlite3.connect(
                path, timeout=0, isolation_level=None, check_same_thread=False
            )
        except sqlite3.Error as error:
            raise ValueError(f"{path}: cannot be opened ({error})") from None
        try:
            self._begin()
        except sqlite3.Error as error:
            self._file.close()
            if "locked" in str(error):
                raise ValueError(f"{path}: another program is using this file") from None
            raise ValueError(f"{path}: not a readable SQLite file ({error})") from None
        except ValueError:
            self._file.close()
            raise

    def _begin(self) -> None:
        """Lock the file and check it, or make the tables."""
        run = self._file.execute
        run("PRAGMA locking_mode = EXCLUSIVE")
        (found,) = run("PRAGMA application_id").fetchone()
        (tables,) = run("SELECT count(*) FROM sqlite_schema").fetchone()
        if tables and found != APPLICATION:
            raise ValueError(f"{self.path}: belongs to another program; needs a file of its own")
        if run("PRAGMA journal_mode = WAL").fetchone() != ("wal",):
            raise ValueError(f"{self.path}: needs a folder in which SQLite can write ahead")
        run("PRAGMA synchronous = FULL")
        run("PRAGMA foreign_keys = ON")
        run("BEGIN IMMEDIATE")  # takes the lock, which stays
        if not tables:
            for statement in TABLES.split(";"):
                run(statement)
            run(f"PRAGMA application_id = {APPLICATION}")
            run(f"PRAGMA user_version = {VERSION}")
        run("COMMIT")
        (version,) = run("PRAGMA user_version").fetchone()
        if version != VERSION:
            raise ValueError(f"{self.path}: has version {version}; needs {VERSION}")
        (state,) = run("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise ValueError(f"{self.path}: is damaged ({state})")

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                yield self._file
            except sqlite3.Error as error:
                raise StoreError(f"the data cannot be read ({error})") from error

    def _write(self, statement: str, values: tuple[Any, ...]) -> None:
        """Do a statement; it is on the disk on return.

        Statements of several threads that wait for the disk share a transaction: the first thread
        that gets the lock commits what all of them have brought.

        Raises:
            StoreError: if that fails; the file has not changed then.
        """
        mine = _Write(statement, values)
        self._waiting.append(mine)
        with self._lock:
            if not mine.done:
                batch = [self._waiting.popleft() for _ in range(len(self._waiting))]
                error = self._commit(batch)
                for write in batch:
                    write.done, write.error = True, error
        if mine.error is not None:
            raise StoreError(f"the data cannot be written ({mine.error})") from mine.error

    def _commit(self, batch: Sequence[_Write]) -> Exception | None:
        """Do statements in one transaction; return the error if it failed and was undone."""
        try:
            self._file.execute("BEGIN IMMEDIATE")
            for write in batch:
                self._file.execute(write.statement, write.values)
            self._file.execute("COMMIT")
        except Exception as error:  # whatever it is, no thread may take its statement for done
            if self._file.in_transaction:
                with suppress(sqlite3.Error):  # the next write fails, too, and tries it again
                    self._file.execute("ROLLBACK")
            return error
        return None

    # --- bins -------------------------------------------------------------------------------------

    def add_bin(
        self, id: str, opened: str, arguments: str, answer: str, keyed: Keyed | None
    ) -> None:
        """Add a bin, and the answer to the request that opened it."""
        key, digest = (None, None) if keyed is None else (keyed.key, keyed.digest)
        self._write(
            "INSERT INTO bins (id, opened, arguments, answer, key, digest) "
            "VALUES (?, ?, ?, ?, ?, ?)", (id, opened, arguments, answer, key, digest),
        )  # fmt: skip

    def bin(self, id: str) -> BinRow | None:
        """Return a bin; None if there is none with this id."""
        rows = self._bins("b.id = ?", id, 1)
        return rows[0] if rows else None

    def bins(self, after: int, limit: int) -> list[BinRow]:
        """Return bins in the order in which they were opened.

        Args:
            after: number of the bin after which to begin.
            limit: largest number of bins.
        """
        return self._bins("b.number > ?", after, limit)

    def latest(self, limit: int) -> list[BinRow]:
        """Return the bins that were opened last, the last one first."""
        return self._bins("b.number > ?", 0, limit, "DESC")

    def _bins(
        self, condition: str, value: Any, limit: int, order: str = "ASC"
    ) -> list[BinRow]:  # fmt: skip
        with self._reading() as file:
            rows = file.execute(
                "SELECT b.number, b.id, b.opened, b.arguments, "
                "(SELECT coalesce(max(step), 0) FROM log WHERE bin = b.number), "
                "EXISTS (SELECT 1 FROM log WHERE bin = b.number AND kind = 'close') "
                f"FROM bins b WHERE {condition} ORDER BY b.number {order} LIMIT ?", (value, limit),
            ).fetchall()  # fmt: skip
        return [
            BinRow(number, name, opened, arguments, step, bool(closed))
            for number, name, opened, arguments, step, closed in rows
        ]

    def count_open(self) -> int:
        """Return the number of bins that are not closed."""
        with self._reading() as file:
            (count,) = file.execute(
                "SELECT (SELECT count(*) FROM bins) "
                "- (SELECT count(*) FROM log WHERE kind = 'close')"
            ).fetchone()
        return int(count)

    def opening(self, key: str) -> tuple[bytes, str] | None:
        """Return digest and answer of the request with this key that opened a bin."""
        with self._reading() as file:
            row = file.execute("SELECT digest, answer FROM bins WHERE key = ?", (key,)).fetchone()
        return None if row is None else (row[0], row[1])

    # --- requests ---------------------------------------------------------------------------------

    def add(self, bin: int, entry: Entry) -> None:
        """Add a request to the log of bin number ``bin``; it is on the disk on return."""
        key, digest = (None, None) if entry.keyed is None else (entry.keyed.key, entry.keyed.digest)
        self._write(
            "INSERT INTO log (bin, step, kind, call, key, digest, answer) "
            "VALUES (?, ?, ?, ?, ?, ?, ?)",
            (bin, entry.step, entry.kind, entry.call, key, digest, entry.answer),
        )

    def keys(self, bin: int) -> set[str]:
        """Return the idempotency keys of the requests to a bin."""
        with self._reading() as file:
            rows = file.execute("SELECT key FROM log WHERE bin = ? AND key NOT NULL", (bin,))
            return {key for (key,) in rows}

    def answered(self, bin: int, key: str) -> tuple[bytes, str]:
        """Return digest and answer of the request to a bin with one of its :meth:`keys`."""
        with self._reading() as file:
            row = file.execute(
                "SELECT digest, answer FROM log WHERE bin = ? AND key = ?", (bin, key)
            ).fetchone()
        return row[0], row[1]

    def changes(self, bin: int) -> list[tuple[str, str | None]]:
        """Return kind and call of every request that changed a bin, in order."""
        with self._reading() as file:
            rows: list[tuple[str, str | None]] = file.execute(
                "SELECT kind, call FROM log WHERE bin = ? AND step IS NOT NULL ORDER BY step",
                (bin,),
            ).fetchall()
        return rows
