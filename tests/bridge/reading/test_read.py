"""`read` of a robot's two runs: what it says of a part of them, of names that are none, and which files it writes."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest
from matplotlib.image import imread
from rosbags.rosbag2 import Reader as Rosbag2Reader

from rosbridge_eth import ledger
from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.capture import CapturedRecord
from rosbridge_eth.cli import run
from rosbridge_eth.errors import ConfigError, ExitCode
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.identity import load_identity, sign
from rosbridge_eth.ledger import packing
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.reader import Reading, read_robot
from rosbridge_eth.robot.assembly import join
from rosbridge_eth.sealing import Sealer
from rosbridge_eth.server.administration import Registered, deploy_contract, init_home, load_ca, register_robot

PASSPHRASE = b"one for all"
Capture = pytest.CaptureFixture[str]


@dataclass(frozen=True)
class Place:
    """An operator's home and its chain. first, last: the blocks of the robot's batches, one for each run."""

    path: Path
    chain: EmbeddedChain
    contract: str
    registered: int
    first: int
    last: int


def message(n: int, topic: str, data: dict[str, object], type_name: str) -> bytes:
    time = 1_790_000_000_000_000_000 + n * 10**9
    return CapturedRecord(topic, type_name, time, time, n, True, data, "reliable").to_json()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder, now = tmp_path_factory.mktemp("read"), datetime.now(UTC)
    home, robot = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
    init_home(home, PASSPHRASE, listen="127.0.0.1:0", public=None, chain_url="http://127.0.0.1:9", server="server",
              now=now)
    keys = Keyring.load(home.accounts, PASSPHRASE)
    chain = EmbeddedChain(fund={keys.operator.address: 10**21})
    deployment = deploy_contract(home, chain, keys)

    def register(name: str) -> Registered:
        return register_robot(home, name, ca=load_ca(home, PASSPHRASE), keys=keys, chain=chain, password=PASSPHRASE,
                              now=now)

    registered, _ = register("robot_1"), register("robot_2")
    join(robot, open_bundle(registered.bundle.read_bytes(), PASSPHRASE), PASSPHRASE)
    identity, _ = load_identity(robot.identity, PASSPHRASE)
    owner, _ = load_identity(home.reader("owner"), PASSPHRASE)
    [account] = [a for a in map(keys.robot, range(1, 10)) if a.address == registered.account]
    chain.fund(account.address, 10**18)
    contract = ledger.Contract.at(chain, deployment.contract)
    blocks, tk = [], identity.public.robot_id
    runs: list[tuple[str, str, dict[str, object]]] = [
        ("/odom", "geometry_msgs/msg/Point", {"x": 1.0, "y": 2.0, "z": 0.0}),
        ("/text", "std_msgs/msg/String", {"data": "hello"}),
    ]
    for number, (topic, type_name, data) in enumerate(runs):
        # Each knows nothing of another: a robot that lost its spool between the two runs.
        sealer = Sealer(tk, partial(sign, identity.signing_key), [owner.encryption_key.public_key])
        records = [r for n in range(3) for r in sealer.seal(message(n + 10 * number, topic, data, type_name), n)]
        contract.transact(account, "setBatch", tk, number, packing.pack([*records, *sealer.end(9)]))
        blocks.append(chain.head().number)
        chain.mine(3)
    (folder / "pass").write_bytes(PASSPHRASE)
    return Place(folder, chain, deployment.contract, registered.block, *blocks)


@pytest.fixture
def place(made: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A copy of it as the current folder; the node's URL leads to the chain in this process."""
    shutil.copytree(made.path, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(ledger, "connect", lambda url, **more: made.chain)
    return made


def reading(place: Place, from_block: int) -> Reading:
    owner, roots = load_identity(place.path / "operator/readers/owner", PASSPHRASE)
    return read_robot(place.chain, place.contract, "robot_1", roots=roots, reader=owner, from_block=from_block)


def read(capsys: Capture, *arguments: str, code: int = 0) -> str:
    assert run(["read", *arguments, "--passphrase-file", "pass"]) == code, capsys.readouterr().err
    shown = capsys.readouterr()
    assert "Traceback" not in shown.err
    return shown.err


# --- a part of the history


def test_all_of_it_is_complete(place: Place, capsys: Capture) -> None:
    assert read(capsys, "robot_1").endswith("robot_1: 6 records proven, 6 chosen; complete\n")


def test_a_block_past_the_end_of_the_chain_is_refused(place: Place, capsys: Capture) -> None:
    head = place.chain.head().number
    for block in (head + 1, 999_999):
        assert f"block {block} is past" in read(capsys, "robot_1", "--from-block", str(block), code=ExitCode.CONFIG)
    with pytest.raises(ConfigError, match=f"whose last block is {head};"):
        reading(place, head + 1)


def test_a_reading_that_began_after_the_records_is_not_called_complete(place: Place, capsys: Capture) -> None:
    for block, count in ((place.last + 1, 0), (place.first + 1, 3)):
        part = reading(place, block)
        assert part.sound and not part.complete
        assert len(part.proven.records) == count
        error = read(capsys, "robot_1", "--from-block", str(block))
        assert f"sound, from block {block} on: its beginning was not read" in error
        assert "complete" not in error and "end is open" not in error
    assert run(["read", "robot_1", "--from-block", str(place.last + 1), "--json", "--passphrase-file", "pass"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["sound"], report["complete"], report["from_block"]) == (True, False, place.last + 1)


def test_a_reading_that_began_before_the_first_record_is_whole(place: Place) -> None:
    for block in (1, place.registered, place.first):
        assert reading(place, block).complete


def test_a_from_block_of_a_reader_toml_is_held_to_the_same(place: Place, capsys: Capture) -> None:
    file = Path("operator/readers/owner/reader.toml")
    with file.open("a") as stream:
        stream.write("from_block = 999999\n")
    assert "reader.toml" in read(capsys, "robot_1", "--config", str(file), code=ExitCode.CONFIG)


def test_a_robot_that_wrote_nothing_yet_is_not_complete(place: Place, capsys: Capture) -> None:
    assert read(capsys, "robot_2").endswith("0 chosen; sound, nothing of it is written yet\n")


# --- names


@pytest.mark.parametrize("name, says", [
    ("robot_9", "no robot of the name robot_9 is registered"),
    ("server", "no robot of the name server is registered"),
    ("Robot", "the name 'Robot' cannot be used"),
    ("", "the name '' cannot be used"),
])
def test_a_name_that_nobody_has_is_no_forgery(place: Place, name: str, says: str, capsys: Capture) -> None:
    error = read(capsys, name, code=ExitCode.IDENTITY)
    assert says in error
    assert "not what the robot wrote" not in error


def test_a_reader_that_does_not_exist_names_those_that_do(place: Place, capsys: Capture) -> None:
    for name in ("nobody", "../readers/owner"):
        assert "there are owner" in read(capsys, "robot_1", "--reader", name, code=ExitCode.IDENTITY)


def test_a_topic_without_records_names_the_topics_there_are(place: Place, capsys: Capture) -> None:
    assert "nothing was read on /nope; what was read is on: /odom, /text" in read(capsys, "robot_1", "--topic", "/nope")


# --- options that contradict each other


@pytest.mark.parametrize("options, named", [
    (["--from", "2026-02-01T00:00:00Z", "--to", "2026-01-01T00:00:00Z"], "--from"),
    (["--at", "2026-02-01T00:00:00Z", "--to", "2026-01-01T00:00:00Z"], "--at"),
    (["--at", "2026-02-01T00:00:00Z", "--from", "2026-01-01T00:00:00Z"], "--at"),
    (["--config", "operator/readers/owner/reader.toml", "--reader", "owner"], "--reader"),
])
def test_options_that_contradict_each_other(place: Place, options: list[str], named: str, capsys: Capture) -> None:
    assert f"Invalid value for {named}" in read(capsys, "robot_1", *options, code=ExitCode.USAGE)


# --- files


@pytest.mark.parametrize("name", ["out.mcap", "out.db3"])
def test_a_bag_with_the_name_of_a_file_is_that_file(place: Place, name: str, capsys: Capture) -> None:
    before = set(Path().iterdir())
    read(capsys, "robot_1", "--bag", name)
    assert set(Path().iterdir()) - before == {Path(name)}
    assert Path(name).read_bytes().startswith(b"\x89MCAP0\r\n" if name.endswith("mcap") else b"SQLite format 3\x00")
    with Rosbag2Reader(name) as bag:
        assert sorted(connection.topic for connection, *_ in bag.messages()) == ["/odom"] * 3 + ["/text"] * 3


def test_a_bag_of_an_unknown_ending_is_refused_with_those_that_are_known(place: Place, capsys: Capture) -> None:
    error = read(capsys, "robot_1", "--bag", "out.zip", code=ExitCode.CONFIG)
    assert ".bag" in error and ".mcap" in error and ".db3" in error
    assert not Path("out.zip").exists()


def test_the_ending_of_a_picture_may_be_in_capitals_and_has_to_be_there(place: Place, capsys: Capture) -> None:
    read(capsys, "robot_1", "--plot", "out.PNG")
    assert imread(Path("out.PNG"), format="png").shape[0] > 100
    for name in ("out", "out.txt"):
        assert ".png, .svg or .pdf" in read(capsys, "robot_1", "--plot", name, code=ExitCode.CONFIG)
        assert not Path(name).exists()


def test_nothing_to_draw_leaves_no_picture(place: Place, capsys: Capture) -> None:
    error = read(capsys, "robot_1", "--topic", "/text", "--plot", "out.png", code=ExitCode.CONFIG)
    assert "none of the 3 chosen records holds a position" in error
    assert not Path("out.png").exists()
