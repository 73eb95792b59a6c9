"""The home of a registered robot whose server is not there, and what stands in its spool."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import rosbridge_eth
from rosbridge_eth import identity as ids
from rosbridge_eth.config.home import BridgeEnd, RobotHome
from rosbridge_eth.log.chunk import Chunk, Log, NoGrant, content_key, drop, open_lines, robot_id
from rosbridge_eth.log.store import NOWHERE
from rosbridge_eth.operator.bundle import Bundle, ask_to_join, join
from rosbridge_eth.robot.spool import Spool
from smcrypto import sm2

PASSWORD = b"robot's"
END = BridgeEnd("robot_1", "server", ["127.0.0.1:9"], 31337, "0x" + "11" * 32, "0x" + "22" * 20)
LOG = Log(END.ledger, robot_id(END.robot))
NOW = datetime.now(UTC)
CA = ids.create_ca("CA", at=NOW)
READER = ids.enrol(CA, ids.Role.READER, "owner", at=NOW)


def lone_robot(folder: Path) -> RobotHome:
    """A home in `folder`, sealing for READER; its password is in `folder`/word."""
    home = RobotHome(folder / "robot")
    request = ask_to_join(home, END.robot, PASSWORD)
    peer = ids.enrol_requests(CA, ids.Role.ROBOT, END.robot, request.signing, request.encryption, at=NOW)
    certificates = {name: text.decode() for name, text in ids.certificate_files(peer, [CA.certificate]).items()}
    join(home, Bundle(END, certificates, {"owner": READER.public.pem.decode()}).signed(CA.key))
    (folder / "word").write_bytes(PASSWORD)
    return home


def command(home: RobotHome, *more: str) -> list[str]:
    """What Python is given to run this robot."""
    arguments = ["--home", str(home.path), "--password-file", str(home.path.parent / "word"), *more]
    return ["-m", "rosbridge_eth", "robot", *arguments]


def environment(**more: str) -> dict[str, str]:
    """Of its process: without the ROS that may be set up here, with the source that is tested."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ROS")}
    return kept | {"PYTHONPATH": str(Path(rosbridge_eth.__file__).parents[1])} | more


def chunks_of(home: RobotHome) -> Iterator[Chunk]:
    """What stands in its spool, the oldest first."""
    spool = Spool(home.spool, LOG, max_bytes=1 << 30, drop=partial(drop, LOG, READER.signing_key))
    yield from [Chunk.parse(chunk) for row in spool.rows(NOWHERE, 100_000) for chunk in spool.chunks([row.place])]
    spool.close()


def lines_of(chunks: Iterable[Chunk], key: sm2.PrivateKey = READER.encryption_key) -> list[dict[str, Any]]:
    """The lines that the key opens."""
    found: list[dict[str, Any]] = []
    for chunk in chunks:
        try:
            found += map(json.loads, open_lines(LOG, chunk, content_key(chunk.header, key)) if chunk.body else ())
        except NoGrant:
            continue
    return found
