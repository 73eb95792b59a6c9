"""A robot with a camera, in real processes: a bag of images at 30 Hz and of point clouds goes through robot, server,
archive and chain, and comes back byte for byte, though the store is killed on the way."""

from __future__ import annotations

import json
import re
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

import faults
from bridge.archive.bags import CAMERA, CLOUD, JPEG, ODOM, bag_of_images
from bridge.archive.s3 import S3
from rosbridge_eth import doctor
from rosbridge_eth.archive import Archive, open_archive
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.identity import Trust, load_identity
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.reading import ProvenRecord, outputs, read_robot

pytestmark = [pytest.mark.service, pytest.mark.slow]
@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, s3: S3) -> Iterator[faults.Site]:
    """A site whose server and reader know the store, and whose robot archives what its topics say."""
    with faults.Site(tmp_path_factory.mktemp("site")) as made:
        for config in (made.home.config, made.reader.config):
            config.write_text(config.read_text() + s3.toml())
        made.restart_server()
        yield made


def read(site: faults.Site, name: str, *more: str, ends: int = 0) -> str:
    arguments = ["read", name, "--home", str(site.reader.path), "--passphrase-file", str(site.folder / "passphrase")]
    program = faults.Program(site.folder / "read.log", [*arguments, *more], {})
    assert program.wait(120) == ends, program.said[-3000:]
    return program.said


def messages_of(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Topic to times and bytes, as ROS 1 has them, of whatever format."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with AnyReader([path]) as bag:
        for connection, at, raw in bag.messages():
            raw = raw if path.suffix == ".bag" else bytes(bag.typestore.cdr_to_ros1(raw, connection.msgtype))
            found.setdefault(connection.topic, []).append((at, bytes(raw)))
    return found


def test_images_and_clouds_come_back_byte_for_byte_though_the_store_is_killed(
    site: faults.Site, s3: S3, tmp_path: Path
) -> None:
    written = bag_of_images(tmp_path / "drive.bag")
    name = site.register()
    site.join(name, home := tmp_path / name)
    (home / "robot.toml").write_text(
        f'topics = ["{ODOM}", {{ topic = "/camera/*", store = "archive" }},'
        f' {{ topic = "{CLOUD}", store = "archive" }}]\n'
        f'[log]\nperiod = "250ms"\n[source]\nkind = "bag"\npath = "{tmp_path / "drive.bag"}"\n'
    )
    robot = site.run_robot(home, tmp_path / "robot.log", {})
    faults.until("a body is in the store", lambda: len(s3.files()) > 2)
    s3.kill()
    faults.until("the robot hears of it", lambda: "archive is away" in robot.said)
    faults.until("the server says so", lambda: well(site) == 1)
    assert "cannot be used" in site.server.said  # type: ignore[union-attr]
    time.sleep(1)
    s3.start()
    assert robot.wait(120) == 0, robot.said[-3000:]
    faults.until("all is on the chain", lambda: not site.outstanding(faults.robot_id(name)), 60)
    faults.until("the archive is well again", lambda: well(site) == 2)
    records = read_all(site, name, open_archive(s3.config()))
    for other in ("back.bag", "back.mcap", "back"):
        with outputs.bag(tmp_path / other) as bag:
            for record in records:
                bag.write(record)
        found = messages_of(tmp_path / other)
        assert {topic: len(of) for topic, of in found.items()} == {topic: len(of) for topic, of in written.items()}
        assert other != "back.bag" or found == written
        for topic in (CAMERA, JPEG, CLOUD):
            # ROS 2's header has no `seq`, which is 4 bytes in front of the rest.
            assert [(at, raw[4:]) for at, raw in found[topic]] == [(at, raw[4:]) for at, raw in written[topic]]

    # Nothing of an image is on the chain, and what is archived cannot be read in the store.
    chunks = site.read(name).chunks
    archived = [chunk for chunk in chunks if chunk.header.archived]
    assert archived and all(chunk.bare for chunk in archived)
    assert sum(len(chunk.encoded) for chunk in chunks) < 40_000 < 5_000_000 < sum(
        chunk.header.body_length for chunk in archived
    )
    assert {chunk.header.body_digest.hex() for chunk in archived} <= {
        file.name.removesuffix("._S3rver_object") for file in s3.files()
    }

    # A body that is gone, one that is altered, and a store that does not answer.
    files = {file.name[:64]: file for file in s3.files()}
    gone, other = (files[archived[n].header.body_digest.hex()] for n in (0, 1))
    gone.rename(tmp_path / "gone")
    content = other.read_bytes()
    other.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    said = read(site, name, "--json", ends=ExitCode.VERIFICATION)
    assert f"the body {gone.name[:64]} is not in the archive" in said
    assert f"the body {other.name[:64]} is another in the archive" in said
    (tmp_path / "gone").rename(gone)
    other.write_bytes(content)
    told = site.reader.config.read_text()
    site.reader.config.write_text(told.partition("[archive]")[0])
    said = read(site, name, "--json")
    site.reader.config.write_text(told)
    assert "in an archive that was not looked into" in said and ": sound," in said
    s3.kill()
    said = read(site, name, ends=ExitCode.STORE)
    assert re.search(r"the archive s3://robots/fleet/a cannot be used", said) and "withheld" not in said
    s3.start()


def read_all(site: faults.Site, name: str, archive: Archive) -> list[ProvenRecord]:
    """The records, proven and sound, of a reader who has kept nothing."""
    reader, roots = load_identity(site.reader.path, (site.folder / "passphrase").read_bytes().strip())
    with closing(Ledger.connect(f"http://127.0.0.1:{site.node_port}", site.home.deployment())) as ledger:
        reading = read_robot([ledger], name, trust=Trust(roots), reader=reader.encryption_key, now=time.time(),
                             bodies=archive.get)  # fmt: skip
        records = list(reading.records())
        assert reading.verdict().sound, [*reading.verdict().lines()]
    return records


def well(site: faults.Site) -> int:
    """How many of the two workers say that the archive is well."""
    try:
        answer = urllib.request.urlopen(f"http://127.0.0.1:{site.monitor_port}/readyz", timeout=5)
    except urllib.error.HTTPError as not_ready:
        answer = not_ready  # type: ignore[assignment]
    conditions = json.load(answer)["conditions"]
    return sum(conditions.get(f"worker-{n} archives bodies", False) for n in range(2))


def test_doctor_tries_the_archive_at_both_ends(site: faults.Site, s3: S3) -> None:
    def tried() -> list[doctor.Finding]:
        found = [*doctor.examine({"archive": doctor.archive}, site.home, None)]
        return [*found, *doctor.examine({"archive": doctor.readers_archive}, site.reader, None)]

    faults.until("the archive is well", lambda: well(site) == 2)
    assert [(each.result, each.found) for each in tried()] == [
        ("ok", "the archive s3://robots/fleet/a was written and read; one small object stays in it"),
        ("ok", "the archive s3://robots/fleet/a answers"),
    ]
    s3.kill()
    for each in tried():
        assert each.result == "broken" and each.found.startswith("the archive s3://robots/fleet/a cannot be used")
        assert "see that it is up" in each.found
    s3.start()
