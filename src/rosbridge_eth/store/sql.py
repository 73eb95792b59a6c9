"""Every SQL statement of the spool and the inbox, each with what it is for.

Both are SQLite in WAL mode with synchronous=FULL: what was committed survives
the loss of power, and only what was committed is ever sent or acknowledged.
`seq` is kept as 8 bytes, big-endian: it orders as it counts, and SQLite's
integers end at 2**63.
"""

from __future__ import annotations

from typing import Final

# --- Spool: one robot, one process ---------------------------------------------------------------------------------

SPOOL_APPLICATION: Final = 0x52425350  # "RBSP"

SPOOL_SCHEMA: Final = """
-- Sealed records not yet acknowledged. place: order of arrival. class: 0 control, 1 reliable, 2 latest.
CREATE TABLE record (
    place INTEGER PRIMARY KEY AUTOINCREMENT,
    class INTEGER NOT NULL,
    stream BLOB NOT NULL,
    seq BLOB NOT NULL,
    ciphertext BLOB NOT NULL
);
-- Finds the oldest record of a class, to drop it at the bound.
CREATE INDEX record_by_class ON record (class, place);
-- Dropped records that no gap record declares yet; `last` is included.
CREATE TABLE undeclared (stream BLOB NOT NULL, first BLOB NOT NULL, last BLOB NOT NULL, PRIMARY KEY (stream, first))
    WITHOUT ROWID;
-- One row: whose spool this is, and the newest record that was ever kept or dropped here.
CREATE TABLE spool (robot BLOB NOT NULL, stream BLOB, seq BLOB);
"""

SPOOL_BIND: Final = "INSERT INTO spool (robot) VALUES (?)"
SPOOL_READ: Final = "SELECT robot, stream, seq FROM spool"
SPOOL_LAST: Final = "UPDATE spool SET stream = ?, seq = ?"
SPOOL_SIZE: Final = "SELECT class, count(*), coalesce(sum(length(ciphertext)), 0) FROM record GROUP BY class"
SPOOL_KEEP: Final = "INSERT INTO record (class, stream, seq, ciphertext) VALUES (?, ?, ?, ?)"
SPOOL_REMOVE: Final = "DELETE FROM record WHERE place = ?"
# The next records to send, after those that were handed out.
SPOOL_NEXT: Final = "SELECT place, class, stream, seq, ciphertext FROM record WHERE place > ? ORDER BY place"
SPOOL_ONE: Final = "SELECT place, class, stream, seq, ciphertext FROM record WHERE place = ?"
# The oldest record of a class after a place.
SPOOL_OLDEST: Final = """
SELECT place, stream, seq, length(ciphertext) FROM record WHERE class = ? AND place > ? ORDER BY place LIMIT 1
"""
UNDECLARED_READ: Final = "SELECT stream, first, last FROM undeclared"
UNDECLARED_WRITE: Final = "INSERT OR REPLACE INTO undeclared (stream, first, last) VALUES (?, ?, ?)"
UNDECLARED_REMOVE: Final = "DELETE FROM undeclared WHERE stream = ? AND first = ?"

# --- Inbox: all robots, several processes --------------------------------------------------------------------------

INBOX_APPLICATION: Final = 0x52424942  # "RBIB"

INBOX_SCHEMA: Final = """
-- Robots seen; turn: when one was last given out, so that all get theirs.
CREATE TABLE robot (no INTEGER PRIMARY KEY, tk BLOB NOT NULL UNIQUE, turn INTEGER NOT NULL DEFAULT 0);
-- Streams seen, numbered as they arrive: their ids are random and order nothing.
CREATE TABLE stream (
    no INTEGER PRIMARY KEY, robot INTEGER NOT NULL REFERENCES robot, id BLOB NOT NULL, UNIQUE (robot, id)
);
-- Records to be written. Leased by `lessee` until `until`; 0 is not leased.
CREATE TABLE record (
    no INTEGER PRIMARY KEY,
    robot INTEGER NOT NULL,
    stream INTEGER NOT NULL,
    seq BLOB NOT NULL,
    ciphertext BLOB NOT NULL,
    arrived REAL NOT NULL,
    lessee TEXT NOT NULL DEFAULT '',
    until REAL NOT NULL DEFAULT 0,
    attempts INTEGER NOT NULL DEFAULT 0,
    UNIQUE (robot, stream, seq)
);
-- Which robots have records to give out, and which are leased.
CREATE INDEX record_by_lease ON record (robot, until);
-- Oldest waiting record.
CREATE INDEX record_by_arrival ON record (arrived);
-- Identities that are finished with; state: 1 done, 2 dead. digest: blake2b-128 of the ciphertext, to know it again.
CREATE TABLE finished (
    stream INTEGER NOT NULL, seq BLOB NOT NULL, digest BLOB NOT NULL, state INTEGER NOT NULL, at REAL NOT NULL,
    PRIMARY KEY (stream, seq)
) WITHOUT ROWID;
CREATE INDEX finished_by_time ON finished (at);
-- Records that will not be written, and why; conflict = 1: other bytes under an identity already taken.
CREATE TABLE dead (
    no INTEGER PRIMARY KEY, stream INTEGER NOT NULL, seq BLOB NOT NULL, digest BLOB NOT NULL, ciphertext BLOB NOT NULL,
    conflict INTEGER NOT NULL, reason TEXT NOT NULL, at REAL NOT NULL, UNIQUE (stream, seq, digest)
);
-- One row: how much is kept, so that the bound is checked without counting.
CREATE TABLE held (records INTEGER NOT NULL, bytes INTEGER NOT NULL);
INSERT INTO held VALUES (0, 0);
"""

INBOX_ROBOT: Final = "SELECT no FROM robot WHERE tk = ?"
INBOX_ADD_ROBOT: Final = "INSERT INTO robot (tk) VALUES (?)"
INBOX_STREAM: Final = """
SELECT robot.no, stream.no FROM stream JOIN robot ON stream.robot = robot.no WHERE robot.tk = ? AND stream.id = ?
"""
INBOX_ADD_STREAM: Final = "INSERT INTO stream (robot, id) VALUES (?, ?)"
INBOX_HELD: Final = "SELECT records, bytes FROM held"
INBOX_HOLD: Final = "UPDATE held SET records = records + ?, bytes = bytes + ?"
INBOX_WAITING: Final = """
SELECT no, ciphertext, arrived, until FROM record WHERE robot = ? AND stream = ? AND seq = ?
"""
INBOX_FINISHED: Final = "SELECT digest, state FROM finished WHERE stream = ? AND seq = ?"
INBOX_ADD: Final = "INSERT INTO record (robot, stream, seq, ciphertext, arrived) VALUES (?, ?, ?, ?, ?)"
INBOX_REMOVE: Final = "DELETE FROM record WHERE no = ?"
INBOX_FINISH: Final = "INSERT INTO finished (stream, seq, digest, state, at) VALUES (?, ?, ?, ?, ?)"
INBOX_BURY: Final = """
INSERT OR IGNORE INTO dead (stream, seq, digest, ciphertext, conflict, reason, at) VALUES (?, ?, ?, ?, ?, ?, ?)
"""
# Whose turn it is, among the robots (or the one asked for) with something to give out and nothing leased to others.
INBOX_TURN: Final = """
SELECT no FROM robot
WHERE (:robot IS NULL OR tk = :robot)
  AND EXISTS (SELECT 1 FROM record WHERE record.robot = robot.no AND until <= :now)
  AND NOT EXISTS (SELECT 1 FROM record WHERE record.robot = robot.no AND until > :now AND lessee <> :consumer)
ORDER BY turn, no LIMIT 1
"""
INBOX_TAKE_TURN: Final = "UPDATE robot SET turn = (SELECT max(turn) FROM robot) + 1 WHERE no = ?"
# Its records in order. The plus keeps SQLite on the index that has this order.
INBOX_NEXT: Final = """
SELECT record.no, tk, id, seq, ciphertext, arrived, attempts
FROM record JOIN robot ON record.robot = robot.no JOIN stream ON record.stream = stream.no
WHERE record.robot = :robot AND +until <= :now ORDER BY record.stream, seq LIMIT :limit
"""
INBOX_HELD_OF: Final = """
SELECT id, seq, ciphertext
FROM record JOIN robot ON record.robot = robot.no JOIN stream ON record.stream = stream.no
WHERE tk = ? ORDER BY record.stream, seq LIMIT ?
"""
INBOX_LEASE: Final = "UPDATE record SET lessee = ?, until = ?, attempts = attempts + 1 WHERE no = ?"
INBOX_RELEASE: Final = """
UPDATE record SET lessee = '', until = 0 WHERE robot = ? AND stream = ? AND seq = ? AND lessee = ?
"""
# All that one consumer has, whatever the robot.
INBOX_RECLAIM: Final = "UPDATE record SET lessee = '', until = 0 WHERE lessee = ?"
INBOX_DEAD: Final = """
SELECT tk, id, seq, ciphertext, conflict, reason, at
FROM dead JOIN stream ON dead.stream = stream.no JOIN robot ON stream.robot = robot.no
WHERE dead.no > ? ORDER BY dead.no LIMIT ?
"""
INBOX_COUNT: Final = """
SELECT (SELECT count(*) FROM record WHERE until <= :now), (SELECT count(*) FROM record WHERE until > :now),
       (SELECT count(*) FROM finished WHERE state = 1), (SELECT count(*) FROM dead),
       (SELECT bytes FROM held), (SELECT min(arrived) FROM record)
"""
INBOX_FORGET: Final = """
DELETE FROM finished WHERE (stream, seq) IN (SELECT stream, seq FROM finished WHERE state = 1 AND at < ? LIMIT ?)
"""
