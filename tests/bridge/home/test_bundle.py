"""A robot joins: its request, the bundle, and the home that it makes of them."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.cli.robot import _say_who
from rosbridge_eth.config.home import BridgeEnd, HomeKind, ReaderHome, RobotHome, kind_of, make_home
from rosbridge_eth.errors import ConfigError, IdentityError
from rosbridge_eth.identity import Role, load_identity
from rosbridge_eth.operator.bundle import (
    Bundle,
    Request,
    ask_to_join,
    join,
    join_with_answer,
    needs_password,
    read_bundle,
)
from rosbridge_eth.robot.loop import reader_keys

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
CA, OTHER_CA = (ids.create_ca("CA", at=NOW - timedelta(days=1000)) for _ in range(2))
READER = ids.enrol(CA, Role.READER, "owner", at=NOW).public
END = BridgeEnd("robot_1", "server", ["192.0.2.7:7410"], 31337, "0x" + "11" * 32, "0x" + "22" * 20)


def answer(
    request: Request, *, ca: ids.CertificateAuthority = CA, role: Role = Role.ROBOT, end: BridgeEnd = END,
    at: datetime = NOW,
) -> Bundle:
    """What `register` makes of a request."""
    peer = ids.enrol_requests(ca, role, request.name, request.signing, request.encryption, at=at)
    certificates = {
        "sign.crt.pem": peer.signing_certificate.to_pem().decode(),
        "enc.crt.pem": peer.encryption_certificate.to_pem().decode(),
        "ca.crt.pem": CA.certificate.to_pem().decode(),
    }
    return Bundle(end, certificates, {"owner": READER.pem.decode()}).signed(CA.key)


def with_keys(password: bytes = b"robot's") -> Bundle:
    """What `register --password-file` makes."""
    files = ids.identity_files(ids.enrol(CA, Role.ROBOT, "robot_1", at=NOW), [CA.certificate], password)
    text = {name: content.decode() for name, content in files.items()}
    keys = {name: text.pop(name) for name in ids.KEY_FILES}
    return Bundle(END, text, {"owner": READER.pem.decode()}, keys).signed(CA.key)


@pytest.fixture
def home(tmp_path: Path) -> RobotHome:
    return RobotHome(tmp_path / "robot")


def test_a_robot_makes_its_keys_and_is_certified_without_showing_them(home: RobotHome) -> None:
    ask_to_join(home, "robot_1", b"robot's")
    request = Request.decode(home.request.read_bytes())
    with pytest.raises(ConfigError, match=r"no certificates yet: carry .*request\.json to the operator"):
        home.bridge()
    sent = answer(request).encode()
    assert not needs_password(sent) and b"PRIVATE" not in sent + home.request.read_bytes()
    assert join(home, read_bundle(sent)) == (CA.certificate.fingerprint().hex(), ["owner"])
    identity, roots = load_identity(home.identity, b"robot's")
    assert identity.name == "robot_1" and roots == (CA.certificate,)
    assert home.bridge() == END and kind_of(home.path) is HomeKind.ROBOT
    assert ids.public_identity((home.readers / "owner.pem").read_bytes()) == READER
    for folder in (home.path, home.identity):
        assert folder.stat().st_mode & 0o777 == 0o700


def test_the_keys_open_under_the_robots_own_password_alone(home: RobotHome) -> None:
    request = ask_to_join(home, "robot_1", b"robot's")
    join(home, answer(request))
    with pytest.raises(IdentityError, match="wrong password"):
        load_identity(home.identity, b"operator's")


def test_a_bundle_with_keys_is_sealed_and_makes_a_home(home: RobotHome) -> None:
    sealed = with_keys().encode(b"robot's")
    assert needs_password(sealed) and b"BEGIN" not in sealed and b"192.0.2.7" not in sealed
    with pytest.raises(IdentityError, match="password is wrong"):
        read_bundle(sealed, b"horse")
    join(home, read_bundle(sealed, b"robot's"), b"robot's")
    assert load_identity(home.identity, b"robot's")[0].name == "robot_1"
    assert "PRIVATE" not in repr(read_bundle(sealed, b"robot's"))
    with pytest.raises(IdentityError, match="protects nothing"):
        with_keys().encode()


def test_nothing_is_written_of_a_bundle_whose_keys_do_not_open(home: RobotHome) -> None:
    with pytest.raises(IdentityError, match="wrong password"):
        join(home, with_keys(b"another"), b"robot's")
    assert not home.path.exists()


def test_a_bundle_for_other_keys_or_of_another_ca_is_refused_and_changes_nothing(
    home: RobotHome, tmp_path: Path
) -> None:
    request = ask_to_join(home, "robot_1", b"robot's")
    elsewhere = ask_to_join(RobotHome(tmp_path / "elsewhere"), "robot_1", b"robot's")
    renamed = ask_to_join(RobotHome(tmp_path / "renamed"), "robot_2", b"robot's")
    before = {path: path.read_bytes() for path in home.path.rglob("*") if path.is_file()}
    swapped = Request("robot_1", request.encryption, request.signing)
    wrong = {
        "other keys": answer(elsewhere),
        "another name": answer(renamed),
        "swapped": answer(swapped),
        "another CA": answer(request, ca=OTHER_CA),
        "a reader": answer(request, role=Role.READER),
        "the end is another's": answer(request, end=replace(END, robot="robot_2")),
        "nothing": replace(answer(request), certificates={}),
    }
    for what, bundle in wrong.items():
        with pytest.raises(IdentityError):
            join(home, bundle)
        assert {path: path.read_bytes() for path in home.path.rglob("*") if path.is_file()} == before, what
    join(home, answer(request))


def test_keys_that_are_certified_anew_join_again_and_another_ledger_does_not(home: RobotHome) -> None:
    request = ask_to_join(home, "robot_1", b"robot's")
    join(home, answer(request))
    home.config.write_text('topics = ["/mine"]\n')
    join(home, answer(request, end=replace(END, servers=["192.0.2.8:7410"])))
    assert home.bridge().servers == ["192.0.2.8:7410"] and "/mine" in home.config.read_text()
    with pytest.raises(ConfigError, match="another ledger"):
        join(home, answer(request, end=replace(END, chain_id=1)))


def test_a_robot_does_not_move_into_a_home_of_another(home: RobotHome, tmp_path: Path) -> None:
    reader = ReaderHome(tmp_path / "reader")
    reader.path.mkdir()
    make_home(reader.path, HomeKind.READER)
    other = RobotHome(reader.path)
    for bundle in (with_keys(), answer(ask_to_join(home, "robot_1", b"robot's"))):
        with pytest.raises(ConfigError, match="a reader's home"):
            join(other, bundle, b"robot's")
    with pytest.raises(ConfigError, match="a reader's home"):
        ask_to_join(other, "robot_1", b"robot's")
    with pytest.raises(ConfigError, match="a robot's home already"):
        ask_to_join(home, "robot_1", b"robot's")
    assert [path.name for path in reader.path.iterdir()] == ["home.json"]


def test_a_bundle_without_keys_says_where_it_belongs(home: RobotHome, tmp_path: Path) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    with pytest.raises(ConfigError, match="made its own keys: join in that robot's home"):
        join(RobotHome(tmp_path / "new"), bundle)
    sealed = RobotHome(tmp_path / "sealed")
    join(sealed, with_keys(), b"robot's")
    with pytest.raises(IdentityError, match="made no request"):
        join(sealed, bundle)


def test_a_robot_whose_clock_begins_in_1970_believes_the_certificates_it_joined_with(home: RobotHome) -> None:
    join(home, answer(ask_to_join(home, "robot_1", b"robot's")))
    assert home.clock_floor() == (NOW - timedelta(days=1)).timestamp()


def test_a_request_that_was_altered_is_refused() -> None:
    request = Request.make("robot_1", *(ids.sm2.PrivateKey.generate() for _ in range(2)))
    head = json.loads(request.encode())
    for change in ({"name": "../robot"}, {"signing": "-----BEGIN"}, {"signing": 5}, {"format": "x"}, {"name": None}):
        with pytest.raises(IdentityError):
            Request.decode(json.dumps(head | change).encode())
    other = json.loads(Request.make("robot_1", *(ids.sm2.PrivateKey.generate() for _ in range(2))).encode())
    forged = Request.decode(json.dumps(head | {"name": "robot_2", "signing": other["signing"]}).encode())
    with pytest.raises(IdentityError, match="CN=robot_2"):
        answer(forged)


@pytest.mark.parametrize("change", [
    {"end": {}}, {"end": 5}, {"readers": {"../x": "pem"}}, {"certificates": 7}, {"keys": None}, {"readers": [5]},
    {"readers": {"owner": 5}}, {"certificates": {"sign.crt.pem": 5}}, {"keys": {"sign.key.pem": None}},
    {"end": asdict(END) | {"genesis": "0x1"}}, {"end": asdict(END) | {"chain_id": "one"}},
    {"end": asdict(END) | {"contract": 7}}, {"end": asdict(END) | {"servers": None}},
    {"end": asdict(END) | {"servers": []}}, {"signature": 7},
    {"end": asdict(END) | {"contract": "0x" + "22 " * 20}}, {"end": asdict(END) | {"server_name": "a\x1b[2Jb"}},
    {"end": asdict(END) | {"server_name": "\u202eb"}}, {"end": asdict(END) | {"servers": ["\x1b[2J:7410"]}},
    *({"end": asdict(END) | {"servers": ["192.0.2.7:7410", f"{host}:7410"]}} for host in (
        "0.0.0.0", "[::]", "0", "0x0", "00.00.0.0", "[::0]", "[0:0:0:0:0:0:0:0]", "[::ffff:0.0.0.0]", "[::ffff:0:0]")),
    {"end": asdict(END) | {"servers": ["192.0.2.7:0"]}},
])
def test_a_bundle_that_was_damaged_is_refused(change: dict[str, object]) -> None:
    bundle = answer(Request.make("robot_1", *(ids.sm2.PrivateKey.generate() for _ in range(2))))
    with pytest.raises(IdentityError) as caught:
        read_bundle(json.dumps(json.loads(bundle.encode()) | change).encode())
    assert str(caught.value).isprintable()


EXPIRED = ids.enrol(CA, Role.READER, "late", at=NOW - timedelta(days=900)).public
STRANGER = ids.enrol(OTHER_CA, Role.READER, "stranger", at=NOW).public
ROBOT_2 = ids.enrol(CA, Role.ROBOT, "robot_2", at=NOW).public


def altered(bundle: Bundle, **change: object) -> Bundle:
    """As it comes out of a file that somebody changed."""
    return read_bundle(json.dumps(json.loads(bundle.encode()) | change).encode())


def test_a_reader_who_is_added_to_a_bundle_on_its_way_is_refused(home: RobotHome) -> None:
    """Even one whom the CA certified: the robot cannot know that it was revoked."""
    request = ask_to_join(home, "robot_1", b"robot's")
    bundle, owner = answer(request), READER.pem.decode()
    revoked = ids.enrol(CA, Role.READER, "revoked", at=NOW).public.pem.decode()
    changes: list[dict[str, object]] = [
        {"readers": {"owner": owner, "revoked": revoked}}, {"readers": {"owner": revoked}}, {"readers": {}},
        {"signature": ""}, {"signature": "00" * 64}, {"signature": "zz"}, {"signature": bundle.signature[2:]},
        {"end": asdict(replace(END, servers=["192.0.2.66:7410"]))}, {"end": asdict(replace(END, chain_id=5))},
    ]
    for change in changes:
        with pytest.raises(IdentityError, match="not what the CA signed"):
            join(home, altered(bundle, **change))
    theirs = replace(bundle, readers={"owner": owner, "revoked": revoked}).signed(OTHER_CA.key)
    with pytest.raises(IdentityError, match="not what the CA signed"):
        join(home, theirs)
    assert not home.bridge_file.exists() and not list(home.readers.iterdir())
    join(home, altered(bundle))


@pytest.mark.parametrize(("name", "reader"), [
    ("late", EXPIRED), ("stranger", STRANGER), ("robot_2", ROBOT_2), ("other", READER),
])
def test_only_readers_of_the_ca_who_had_not_ended_are_taken_by_their_own_names(
    home: RobotHome, name: str, reader: ids.PeerIdentity
) -> None:
    request = ask_to_join(home, "robot_1", b"robot's")
    bundle = replace(answer(request), readers={"owner": READER.pem.decode(), name: reader.pem.decode()}).signed(CA.key)
    with pytest.raises(IdentityError):
        join(home, bundle)
    assert not home.bridge_file.exists() and not list(home.readers.iterdir())


def test_an_older_bundle_is_not_taken_up_again(home: RobotHome) -> None:
    """It names the readers of then."""
    request = ask_to_join(home, "robot_1", b"robot's")
    old, new = answer(request, at=NOW), answer(request, at=NOW + timedelta(days=3))
    join(home, old)
    join(home, new)
    with pytest.raises(IdentityError, match="older than the one"):
        join(home, old)
    join(home, new)


def test_who_joins_is_told_the_readers_by_name(home: RobotHome, capsys: pytest.CaptureFixture[str]) -> None:
    request = ask_to_join(home, "robot_1", b"robot's")
    other = ids.enrol(CA, Role.READER, "insurer", at=NOW).public.pem.decode()
    bundle = replace(answer(request), readers={"owner": READER.pem.decode(), "insurer": other}).signed(CA.key)
    _say_who(join(home, bundle))
    assert "can open this robot's records: insurer, owner." in capsys.readouterr().err


def test_a_robot_does_not_seal_for_a_reader_whose_certificates_have_ended(
    home: RobotHome, caplog: pytest.LogCaptureFixture
) -> None:
    join(home, answer(ask_to_join(home, "robot_1", b"robot's")))
    (home.readers / "late.pem").write_bytes(EXPIRED.pem)
    home.raise_clock_floor(NOW.timestamp() + 10 * 86_400)
    assert reader_keys(home, [CA.certificate]) == [READER.encryption_certificate.public_key]
    assert "not sealed for reader late: its certificate ended at" in caplog.text
    (home.readers / "owner.pem").unlink()
    with pytest.raises(ConfigError, match="certificates of all readers have ended"):
        reader_keys(home, [CA.certificate])


@pytest.mark.parametrize("part", ["certificates", "keys"])
@pytest.mark.parametrize("name", ["../../.profile", "/tmp/rosbridge-eth-planted", "note.txt"])
def test_a_bundle_writes_no_file_but_an_identitys(home: RobotHome, tmp_path: Path, part: str, name: str) -> None:
    """Who could change a bundle on its way is found out by the fingerprint, after the files are written."""
    head = json.loads(answer(ask_to_join(home, "robot_1", b"robot's")).encode())
    head[part][name] = "planted"
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(IdentityError, match="damaged"):
        join(home, read_bundle(json.dumps(head).encode()))
    assert sorted(tmp_path.rglob("*")) == before and not Path(name).exists()


def test_a_crash_while_joining_is_repaired_by_joining_again(home: RobotHome, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    writes, real = 0, os.replace

    def dies(at: int) -> None:
        def counted(*args: object) -> None:
            nonlocal writes
            writes += 1
            if writes == at:
                raise KeyboardInterrupt
            real(*args)  # type: ignore[arg-type]
        monkeypatch.setattr(os, "replace", counted)

    for at in range(1, 7):
        writes = 0
        dies(at)
        with pytest.raises(KeyboardInterrupt):
            join(home, bundle)
        monkeypatch.setattr(os, "replace", real)
        join(home, bundle)
        assert load_identity(home.identity, b"robot's")[0].name == "robot_1" and home.bridge() == END


def test_a_bundle_that_cannot_be_taken_up_ends_no_robot_that_has_joined(
    home: RobotHome, caplog: pytest.LogCaptureFixture
) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    home.answer.write_bytes(bundle.encode()[:-100])  # a copy that was cut short
    with pytest.raises(IdentityError, match=f"{home.answer} is not used: this is no bundle file .* damaged"):
        join_with_answer(home)
    join(home, bundle)
    assert join_with_answer(home) is None and home.answer.exists()
    assert f"{home.answer} is not used: this is no bundle file" in caplog.text
    home.answer.write_bytes(bundle.encode())
    assert join_with_answer(home) is not None


def test_a_damaged_bridge_file_is_repaired_by_joining_again_as_its_error_says(home: RobotHome) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    join(home, bundle)
    home.bridge_file.write_text('{"robot": "robot_1"')
    with pytest.raises(ConfigError, match="join again"):
        home.bridge()
    home.answer.write_bytes(bundle.encode())
    assert join_with_answer(home) is not None and home.bridge() == END


def test_a_bundle_that_answers_no_request_is_not_passed_over_without_a_word(
    home: RobotHome, caplog: pytest.LogCaptureFixture
) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    join(home, bundle)
    home.request.unlink()
    home.answer.write_bytes(bundle.encode())
    assert join_with_answer(home) is None and "has made no request that this bundle could answer" in caplog.text
    with pytest.raises(ConfigError, match="run `join --name NAME"):
        join_with_answer(RobotHome(home.path.parent))


def test_after_joining_again_the_readers_are_those_of_the_bundle_wherever_a_crash_fell(
    home: RobotHome, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bundle = answer(ask_to_join(home, "robot_1", b"robot's"))
    pem, real = READER.pem.decode(), Path.unlink
    stays, goes, comes = (ids.enrol(CA, Role.READER, n, at=NOW).public.pem.decode() for n in ("stays", "goes", "comes"))
    before = replace(bundle, readers={"owner": pem, "stays": stays, "goes": goes}).signed(CA.key)
    after = replace(bundle, readers={"owner": pem, "stays": stays, "comes": comes}).signed(CA.key)

    def dies(path: Path, missing_ok: bool = False) -> None:
        if path.suffix == ".pem":
            raise KeyboardInterrupt
        real(path, missing_ok)

    join(home, before)
    (home.readers / "by_hand.pem").write_text(pem)
    (home.readers / "note.txt").write_text("not a certificate")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "unlink", dies)
        join(home, after)
    assert after.readers.keys() <= {file.stem for file in home.readers.glob("*.pem")}, "nobody is left out"
    home.answer.write_bytes(after.encode())
    join_with_answer(home)
    assert {file.name for file in home.readers.iterdir()} == {"owner.pem", "stays.pem", "comes.pem", "note.txt"}
    assert "no longer sealed for by_hand, goes" in caplog.text and not home.answer.exists()
