"""The how-to pages and docs/operations.md, command by command, as they are written there."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from mcap.reader import make_reader

from bridge.pages import ROOT, type_page
from bridge.sources.ros2.graph import free_domain, ros2_python
from conftest import unavailable
from ports import free_port
from rosbridge_eth.config import load_robot_config, load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.errors import ChainError
from rosbridge_eth.identity import load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator.bundle import Request, ask_to_join, join, read_bundle
from rosbridge_eth.robot.sources import sample_bag
from rosbridge_eth.server.shard import open_store

pytestmark = [pytest.mark.service, pytest.mark.slow]
WORDS = {"operator": "an operator's passphrase", "reader": "the owner's passphrase", "robot": "a robot's password"}


PATRON = """
import json, pathlib, sys, time
from urllib.request import Request, urlopen
accounts = pathlib.Path(sys.argv[1])
while not accounts.exists():
    time.sleep(0.2)
account = json.loads(accounts.read_text())["operator"]
body = dict(jsonrpc="2.0", id=1, method="anvil_setBalance", params=[account, hex(10**20)])
urlopen(Request("{}", json.dumps(body).encode(), dict([("Content-Type", "application/json")])))
"""
"""Puts 100 ETH on the account that `init` names, as its owner would."""


SERVER = "rosbridge-eth server 2> server.log &\nuntil grep -q Listening server.log; do sleep 0.2; done"


@pytest.fixture(scope="module")
def made(require: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Anvil]]:
    """What the walkthrough leaves: homes of an operator, a robot and a reader, and a chain that has the contract."""
    require("npx")
    folder, now = tmp_path_factory.mktemp("made"), datetime.now(UTC)
    words = {name: text.encode() for name, text in WORDS.items()}
    (folder / "secrets").mkdir()
    for name, text in WORDS.items():
        (folder / "secrets" / name).write_text(text + "\n")
    with Anvil.start(free_port()) as anvil:
        home, robot = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
        keys = admin.init_home(
            home, words["operator"], reader=ReaderHome(folder / "reader"), reader_passphrase=words["reader"], now=now,
            listen=f"127.0.0.1:{free_port(socket.SOCK_DGRAM, 2)}", chain_url=anvil.url,
        )
        anvil.fund(keys.operator.address, 1000)
        deployment = admin.deploy_contract(home, anvil.url, keys)
        ask_to_join(robot, "robot_1", words["robot"])
        ledger = Ledger.connect(anvil.url, deployment)
        registered = admin.register_robot(
            home, "robot_1", ca=load_ca(home.ca, words["operator"], now), keys=keys, ledger=ledger,
            inbox=lambda: open_store(load_server_config(home.config), home), now=now,
            request=Request.decode(robot.request.read_bytes()),
        )  # fmt: skip
        ledger.close()
        join(robot, read_bundle(registered.bundle.read_bytes()))
        yield folder, anvil


@pytest.fixture
def place(made: tuple[Path, Anvil], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of it, and the chain as it was. Passphrases are where a script would have them."""
    folder = shutil.copytree(made[0], tmp_path / "here")
    for name in WORDS:
        monkeypatch.setenv(f"ROSBRIDGE_ETH_{name.upper()}_PASSPHRASE_FILE", str(folder / "secrets" / name))
    before = made[1].ask("evm_snapshot")
    yield folder
    made[1].ask("evm_revert", before)


def test_ros_1(place: Path, require: Callable[[str], str]):
    for program in ("rosmaster", "rosbag"):
        require(program)
    shutil.copy(sample_bag(), place / "robot_1.bag")
    said = type_page(
        "howto-ros1.md", place, ports={"11311": free_port()}, environment={"ROS_LOG_DIR": str(place)},
        before=SERVER,
    )
    captured = re.search(r"(\d+) records captured", said)
    assert captured and int(captured[1]) == 300, said[-3000:]
    assert (place / "recovered.bag").stat().st_size > 10_000


def test_ros_2(place: Path):
    python = ros2_python()
    publish = place / ".programs" / "ros2"  # `ros2 topic pub`, which a full ROS has, by the rclpy that is here
    publish.parent.mkdir()
    publish.write_text(f'#!/bin/sh\nexec "{python}" "{ROOT / "tests/bridge/sources/ros2/topic_pub.py"}" "$@"\n')
    publish.chmod(0o755)
    type_page("howto-ros2.md", place, ports={"7": free_domain(44)}, python=python)


def test_black_box(place: Path):
    (place / "robot" / "robot.toml").unlink()
    type_page("howto-black-box.md", place, before=SERVER)


def test_evidence(place: Path, made: tuple[Path, Anvil]):
    (place / "robot" / "robot.toml").unlink()
    type_page("howto-evidence.md", place, before=SERVER, ports={"8545": int(made[1].url.rpartition(":")[2])})
    shown = json.loads((place / "shown.json").read_text())
    assert len(shown["records"]) == 50 and len((place / "records.jsonl").read_text().splitlines()) == 1
    assert b"<html" in (place / "moment.html").read_bytes()


def test_redis(place: Path, require: Callable[[str], str]):
    require("redis-server")
    port = free_port()
    said = type_page(
        "howto-redis.md", place, ports={"6379": port},
        before=f"""
redis-cli() {{ command redis-cli -p {port} "$@"; }}
redis-server() {{ command redis-server "$@" --port {port}; }}
""",
    )
    assert "PASSWORD" not in said


def test_shards_on_two_machines(place: Path):
    """Two homes, a copy each of the operator's, stand for two machines; both write to one contract."""
    listen = load_server_config(OperatorHome(place / "operator").config).listen.port
    (place / "robot/robot.toml").write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\nduration = "5s"\n')
    said = type_page("howto-shards.md", place, marked="shards", ports={"7410": listen, "7411": listen + 1}, after="""
rosbridge-eth robot
for robot in robot_1 robot_3; do
    until rosbridge-eth read $robot > $robot.jsonl && [ $(grep -c odom $robot.jsonl) -ge 50 ]; do sleep 1; done
done
rosbridge-eth status --json > first.json
rosbridge-eth status --home second --json > second.json
""")
    assert said.count("Listening on UDP") == 2
    for name, own, other in (("first", "robot_1", "robot_3"), ("second", "robot_3", "robot_1")):
        report = json.loads((place / f"{name}.json").read_text())
        assert report["process"] == [] and report["robots"][other]["chunks"] > 0
        assert "waiting" in report["robots"][own] and "waiting" not in report["robots"][other]


def test_watch(place: Path, require: Callable[[str], str]):
    """Typed, and looked at: the file has its index, and who was granted a span has its records."""
    require("curl")
    type_page(
        "howto-watch.md", place, ports={"8080": free_port()},
        before="rosbridge-eth server 2> server.log &\nuntil grep -q Listening server.log; do sleep 0.2; done\n"
        "set -m; disown",
    )
    assert "<title>Robots, as proven from the chain</title>" in (place / "page.html").read_text()
    with (place / "watched.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count == 50
    assert [schema.encoding for schema in summary.schemas.values()] == ["ros2msg"] * len(summary.schemas)
    granted = [json.loads(line) for line in (place / "granted.jsonl").read_text().splitlines()]
    assert len(granted) == 50 and {record["topic"] for record in granted} == {"/robot_1/odom"}


def test_poa(place: Path, require: Callable[[str], str]):
    require("jq")
    geth = os.environ.get("GETH")
    if not geth or not Path(geth).exists():
        unavailable("GETH does not name a geth that signs Clique blocks (benchmarks/install_geth.sh builds one)")
    (place / ".programs").mkdir()
    (place / ".programs" / "geth").symlink_to(str(geth))
    home, reader = OperatorHome(place / "new"), ReaderHome(place / "new-reader")
    words = (WORDS["operator"].encode(), WORDS["reader"].encode())
    admin.init_home(home, words[0], reader=reader, reader_passphrase=words[1], now=datetime.now(UTC),
                    listen=f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}")  # fmt: skip
    home.config.write_text(home.config.read_text().partition("[chain]")[0])
    shutil.rmtree(place / "operator")
    home.path.rename(place / "operator")
    type_page("howto-poa.md", place, ports={"8545": free_port()})


def test_services(made: tuple[Path, Anvil], tmp_path: Path, require: Callable[[str], str]):
    """As root of a machine that is this one with its own /etc, /opt and /var/lib; service.py is its systemd."""
    for program in ("unshare", "useradd", "jq", "systemd-analyze"):
        require(program)
    if os.geteuid() != 0:
        unavailable("only root can have an /etc of its own")
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    for name in ("deploy", "pyproject.toml"):
        (checkout / name).symlink_to(ROOT / name)
    _, anvil = made
    (patron := tmp_path / "patron.py").write_text(PATRON.format(anvil.url))
    site = next(path for path in sys.path if path.endswith("site-packages"))
    program = (
        f"PYTHONPATH=/opt/src:/opt/site LD_LIBRARY_PATH=/opt/python/lib"
        f' exec /opt/python/bin/python3.{sys.version_info.minor} -m rosbridge_eth "$@"'
    )
    before = f"""
cp -a /etc {tmp_path}/etc; mount --bind {tmp_path}/etc /etc
mount -t tmpfs tmpfs /var/lib
mount -t tmpfs tmpfs /opt; chmod 755 /opt
mkdir /opt/python /opt/site /opt/src
mount --bind {sys.base_prefix} /opt/python; mount --bind {site} /opt/site; mount --bind {ROOT}/src /opt/src
python3() {{  # stands for what README.md's first command does in every run: an environment with the package
    [ "$*" = "-m venv /opt/rosbridge-eth" ]
    cd /opt && mkdir -p rosbridge-eth/bin && cd rosbridge-eth/bin
    echo '[ "$*" = "install .[bridge]" ] && grep -q pysmcrypto pyproject.toml' > pip
    echo '{program}' > rosbridge-eth
    sed -i '1i#!/bin/sh' pip rosbridge-eth
    chmod 755 pip rosbridge-eth
    cd {checkout}
}}
systemctl() {{ {sys.executable} {ROOT}/tests/bridge/service.py "$@"; }}
journalctl() {{ cat /etc/journal; }}
{sys.executable} {patron} /var/lib/rosbridge-eth/operator/accounts.json &
"""
    ports = {"8545": int(anvil.url.rpartition(":")[2]), "7410": free_port(socket.SOCK_DGRAM)}
    type_page("operations.md", checkout, ports=ports, before=before, shell=("unshare", "--mount", "bash"),
              typed="an operator's passphrase\n")  # fmt: skip


def test_another_operator_takes_over(place: Path, made: tuple[Path, Anvil], require: Callable[[str], str]):
    require("jq")
    anvil = made[1]
    (patron := place / "patron.py").write_text(PATRON.format(anvil.url))
    (place / "secrets" / "new").write_text("the new operator's passphrase\n")
    ledger = Ledger.connect(anvil.url, OperatorHome(place / "operator").deployment())
    before = ledger.operator()
    ports = {"8545": int(anvil.url.rpartition(":")[2]), "7410": free_port(socket.SOCK_DGRAM)}
    type_page("operations.md", place, ports=ports, marked="handover",
              before=f"{sys.executable} {patron} new/accounts.json &")
    assert before != ledger.operator() == OperatorHome(place / "new").account
    with pytest.raises(ChainError, match="NotOperator"):
        keys = Keyring.load(OperatorHome(place / "operator").accounts, WORDS["operator"].encode())
        ledger.transact(keys.operator, "offerOperator", before)
    ledger.close()
    (place / "robot/robot.toml").write_text(
        'topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\nduration = "5s"\nspeed = "max"\n'
    )
    script = """
export PATH="$PWD/.programs:$PATH"
rosbridge-eth server --home new --passphrase-file secrets/new 2> server.log &
trap 'kill %1' EXIT
until grep -q Listening server.log; do sleep 0.2; done
rosbridge-eth robot
until rosbridge-eth read robot_1 --home new-reader > read.jsonl; grep -q odom read.jsonl; do sleep 1; done
"""
    subprocess.run(["bash", "-euc", script], cwd=place, check=True, timeout=120)
    assert (place / "read.jsonl").read_text().count('"topic":"/robot_1/odom"') == 50


def test_a_fleets_ca_is_the_bridges(tmp_path: Path):
    """The first block of the page makes the CA, the last one gives it to the bridge."""
    page = (ROOT / "docs" / "fleet-ca.md").read_text(encoding="utf-8")
    [first, *_] = re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    python = f'python() {{ PYTHONPATH={ROOT}/src {sys.executable} "$@"; }}'
    type_page("fleet-ca.md", tmp_path, before=f"{python}\n{first}", marked="bridge")
    assert not (tmp_path / "operator" / "ca").exists()
    assert (tmp_path / "operator/ca.crt.pem").read_bytes() == (tmp_path / "fleet/ca.crt.pem").read_bytes()
    load_ca(OperatorHome(tmp_path / "operator").ca, b"a long passphrase for the CA", datetime.now(UTC))


PAGES = sorted(path.name for path in (ROOT / "docs").glob("*.md"))
_TOML = re.compile(r"^```toml[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("howto") or page == "operations.md"])
def test_every_piece_of_a_configuration_on_a_page_is_one(page: str, tmp_path: Path):
    for number, text in enumerate(_TOML.findall((ROOT / "docs" / page).read_text(encoding="utf-8"))):
        file = tmp_path / f"{number}.toml"
        file.write_text(text)
        (load_robot_config if re.search(r"^(topics|nodes)", text, re.MULTILINE) else load_server_config)(file)
