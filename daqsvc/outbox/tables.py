"""The tables of the journal, how earlier ones become them, and whether a row is as it was written."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from daqsvc import __version__
from daqsvc.outbox.files import corruption, pragma
from daqsvc.outbox.messages import NewerOutboxError, checksum, is_sound
from daqsvc.outbox.written_by import written_by

if TYPE_CHECKING:
    import sqlite3
    from pathlib import Path

Row: TypeAlias = tuple[int, str, bytes, int, int, int, int]
"""Number, topic, payload, whether it is retained, whether it is sent, ns since the Unix epoch, checksum."""

SCHEMA_VERSION = 2

_SCHEMA = """
CREATE TABLE messages (
    sequence INTEGER PRIMARY KEY AUTOINCREMENT,
    topic TEXT NOT NULL,
    payload BLOB NOT NULL,
    retain INTEGER NOT NULL,
    sent INTEGER NOT NULL DEFAULT 0,
    wall_ns INTEGER NOT NULL DEFAULT 0,
    checksum INTEGER
);
CREATE INDEX unsent ON messages (sequence) WHERE NOT sent;
"""

_SCHEMA_2 = """
CREATE INDEX sent ON messages (sequence) WHERE sent;
CREATE TABLE latest (topic TEXT PRIMARY KEY, sequence INTEGER NOT NULL) WITHOUT ROWID;
"""

_FROM_1_TO_2 = f"""
ALTER TABLE messages ADD COLUMN wall_ns INTEGER NOT NULL DEFAULT 0;
ALTER TABLE messages ADD COLUMN checksum INTEGER;
UPDATE messages SET checksum = checksum_of(sequence, topic, payload);
DROP INDEX retained;
{_SCHEMA_2}
"""  # noqa: S608  constants only

FILL_LATEST = """
INSERT INTO latest SELECT topic, max(sequence) FROM messages WHERE retain GROUP BY topic
"""


_PARTS = {
    ("messages", "sequence,topic,payload,retain,sent,wall_ns,checksum"),
    ("latest", "topic,sequence"),
    ("unsent", None),
    ("sent", None),
}
"""Names of tables and indexes, with the columns of the former."""

_FOUND = """
SELECT name, (SELECT group_concat(name) FROM pragma_table_info(parts.name)) FROM sqlite_master AS parts
WHERE name NOT LIKE 'sqlite\\_%' ESCAPE '\\'
"""


def version_of(connection: sqlite3.Connection, writer: str) -> int:
    """The version that the file gives for its tables; 0 for a new one.

    Another number than `SCHEMA_VERSION` is damage if the tables are of `SCHEMA_VERSION` to the last column
    and nothing shows that another program has written them: no version changes the number alone.

    Args:
        connection: to the file.
        writer: the version of the program that has written it last; empty if that is not known.

    Raises:
        sqlite3.DatabaseError: the number is damaged.
    """
    version = pragma(connection, "user_version")
    if version == SCHEMA_VERSION:
        return version
    is_ours = version < SCHEMA_VERSION or writer in {"", __version__}
    if version < 0 or (is_ours and set(connection.execute(_FOUND)) == _PARTS):
        raise corruption(f"schema version {version} with the tables of {SCHEMA_VERSION}")
    return version


def known_version(connection: sqlite3.Connection, path: Path) -> int:
    """See `version_of`.

    Raises:
        NewerOutboxError: this program does not know it.
    """
    writer = written_by(path)
    version = version_of(connection, writer)
    if version > SCHEMA_VERSION:
        raise NewerOutboxError(
            f"outbox {path} has schema version {version}, written by {newer_writer(writer)}; this "
            f"is daqsvc {__version__}, which knows {SCHEMA_VERSION}: install that version again, or give "
            f"the service another store"
        )
    return version


def newer_writer(writer: str) -> str:
    """Who has written a file with newer tables, as far as that is known."""
    return "a newer version of daqsvc" if writer in {"", __version__} else f"daqsvc {writer}"


def bring_up_to_date(connection: sqlite3.Connection, version: int, wall_ns: int) -> None:
    """Create the tables in a new file, or change those of an earlier version; all or nothing.

    Args:
        connection: to the file.
        version: what the file has; 0 for a new one.
        wall_ns: wall clock, for messages of a version that did not store theirs.

    Raises:
        sqlite3.Error: the file is as it was.
    """
    connection.create_function("checksum_of", 3, checksum, deterministic=True)
    statements = _SCHEMA + _SCHEMA_2 if version == 0 else f"{_FROM_1_TO_2} {FILL_LATEST};"
    connection.executescript(
        f"""
        BEGIN IMMEDIATE;
        {statements}
        UPDATE messages SET wall_ns = {wall_ns};
        PRAGMA user_version = {SCHEMA_VERSION};
        COMMIT;
        """  # noqa: S608  constants and a number
    )


def sound_row(raw: tuple[object, ...], unsent: set[int]) -> Row | None:
    """What a row states; None if it has changed on the disk.

    Args:
        raw: its columns as they were read, text as bytes.
        unsent: numbers of messages that another source takes for unsent.
    """
    sequence, name, payload, retain, sent, wall_ns, check = raw
    try:
        topic = name.decode() if isinstance(name, bytes) else None
    except UnicodeDecodeError:
        return None
    if not (isinstance(sequence, int) and isinstance(topic, str) and isinstance(payload, bytes)):
        return None
    if not isinstance(check, int) or not is_sound(sequence, topic, payload, check):
        return None
    is_sent = sent == 1 and sequence not in unsent
    written_ns = wall_ns if isinstance(wall_ns, int) else 0
    return sequence, topic, payload, int(retain != 0), int(is_sent), written_ns, check
