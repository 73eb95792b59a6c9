"""Both archives keep what they are given, say what they do not have, and tell that from not answering."""

from __future__ import annotations

import http.server
import os
import random
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from email.utils import formatdate
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from bridge.archive.s3 import BUCKET, S3
from rosbridge_eth.archive import PROBE, Archive, Bucket, Folder, open_archive
from rosbridge_eth.config.models import ArchiveConfig
from rosbridge_eth.errors import ConfigError, IdentityError, StoreError
from smcrypto import sm3

BODY = random.Random(1).randbytes(6_000_000)
DIGEST = sm3.digest(BODY)
pytest.importorskip("obstore")


@pytest.fixture(params=["folder", pytest.param("s3", marks=pytest.mark.service)])
def archive(request: pytest.FixtureRequest, tmp_path: Path) -> Archive:
    if request.param == "folder":
        return open_archive(ArchiveConfig.model_validate({"url": str(tmp_path)}))
    return open_archive(request.getfixturevalue("s3").config(prefix=tmp_path.name))


def test_what_was_put_is_got_as_often_as_one_likes(archive: Archive) -> None:
    assert archive.get(DIGEST, len(BODY)) is None
    for _ in range(2):
        archive.put(DIGEST, BODY)
        assert archive.get(DIGEST, len(BODY)) == BODY
    archive.put(b"\0" * 32, b"x")
    assert archive.get(b"\0" * 32, 1) == b"x"


def test_no_more_is_read_than_is_expected_and_one_byte_that_shows_there_is_more(archive: Archive) -> None:
    archive.put(DIGEST, BODY)
    assert archive.get(DIGEST, 100) == BODY[:101]


def test_a_check_leaves_one_object_and_finds_an_archive_that_forgets(archive: Archive, monkeypatch: Any) -> None:
    archive.check()
    archive.check()
    assert archive.get(sm3.digest(PROBE), len(PROBE)) == PROBE
    monkeypatch.setattr(type(archive), "get", lambda self, digest, length: None)
    with pytest.raises(StoreError, match="does not give back"):
        archive.check()


@pytest.mark.service
def test_a_folder_and_a_bucket_have_the_same_names(s3: S3, tmp_path: Path) -> None:
    for archive in (Folder(tmp_path), open_archive(s3.config(prefix="same"))):
        archive.put(DIGEST, b"body")
    [file] = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert str(file.relative_to(tmp_path)) == f"{DIGEST.hex()[:2]}/{DIGEST.hex()}"
    names = [str(path.relative_to(s3.objects / BUCKET)) for path in s3.files()]
    assert f"same/{file.relative_to(tmp_path)}._S3rver_object" in names


# What does not answer is told, and is not taken for one that has nothing


def test_a_folder_that_is_not_there_is_not_made_and_not_empty(tmp_path: Path) -> None:
    archive = Folder(tmp_path / "not mounted")
    for call in (lambda: archive.put(DIGEST, b"x"), lambda: archive.get(DIGEST, 1)):
        with pytest.raises(StoreError, match="mount it"):
            call()
    assert not (tmp_path / "not mounted").exists()


def test_what_somebody_removed_is_made_again(tmp_path: Path) -> None:
    archive = Folder(tmp_path)
    archive.put(DIGEST, b"body")
    shutil.rmtree(tmp_path / DIGEST.hex()[:2])
    archive.put(DIGEST, b"body")
    assert archive.get(DIGEST, 4) == b"body"


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / DIGEST.hex()[:2]).write_text("a file where a folder has to be")
    with pytest.raises(StoreError, match="cannot be used"):
        Folder(tmp_path).put(DIGEST, b"x")


@pytest.mark.service
def test_a_bucket_that_is_not_there_is_not_an_empty_one(s3: S3) -> None:
    archive = open_archive(s3.config(url="s3://another-bucket"))
    for call in (lambda: archive.put(DIGEST, b"x"), lambda: archive.get(DIGEST, 1)):
        with pytest.raises(StoreError, match="s3://another-bucket cannot be used"):
            call()


class Refusing(http.server.BaseHTTPRequestHandler):
    """An S3 that lets nobody in, and says at length what it was asked."""

    def do_GET(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.send_response(403)
        self.end_headers()
        words = f"<Error><Code>AccessDenied</Code>\x1b[31m\n{self.headers}</Error>"
        self.wfile.write(words.encode())

    do_PUT = do_DELETE = do_POST = do_GET

    def log_message(self, format: str, *arguments: Any) -> None: ...


class Empty(Refusing):
    """An S3 with an object of no bytes, of which there is no range."""

    def do_GET(self) -> None:
        self.send_response(416 if "Range" in self.headers else 200)
        for name, value in (("Content-Length", "0"), ("ETag", '"0"'), ("Last-Modified", formatdate(usegmt=True))):
            self.send_header(name, value)
        self.end_headers()


@contextmanager
def serving(handler: type[Refusing]) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.fixture
def refusing() -> Iterator[str]:
    with serving(Refusing) as url:
        yield url


def test_an_object_of_no_bytes_is_no_body_and_not_an_archive_that_is_away(tmp_path: Path) -> None:
    with serving(Empty) as url:
        (keys := tmp_path / "keys").write_text("id secret")
        keys.chmod(0o600)
        archive = open_archive(ArchiveConfig.model_validate({"url": "s3://robots", "endpoint": url, "keys": str(keys)}))
        assert archive.get(DIGEST, 100) == b""
    (tmp_path / DIGEST.hex()[:2]).mkdir()
    (tmp_path / DIGEST.hex()[:2] / DIGEST.hex()).touch()
    assert Folder(tmp_path).get(DIGEST, 100) == b""


def test_a_store_that_refuses_or_is_away_is_an_error_without_the_secret(tmp_path: Path, refusing: str) -> None:
    keys = tmp_path / "keys"
    keys.write_text("AKIDEXAMPLE wJalrXUtnFEMI")
    keys.chmod(0o600)
    for endpoint in (refusing, "http://127.0.0.1:1"):
        config = ArchiveConfig.model_validate({"url": "s3://robots", "endpoint": endpoint, "keys": str(keys)})
        archive = open_archive(config)
        for call in (lambda: archive.get(DIGEST, 1), lambda: archive.put(DIGEST, b"x")):  # noqa: B023
            with pytest.raises(StoreError) as refused:
                call()
            told = f"{refused.value} {archive!r} {config!r} {refused.value.__cause__}"
            assert "wJalrXUtnFEMI" not in told and str(refused.value).isprintable() and len(str(refused.value)) < 450


# How it is configured


def test_keys_that_others_may_read_or_that_are_none_are_refused(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    keys.write_text("ID SECRET")
    keys.chmod(0o644)
    config = ArchiveConfig.model_validate({"url": "s3://robots", "keys": str(keys)})
    with pytest.raises(IdentityError, match="chmod 600"):
        open_archive(config)
    keys.chmod(0o600)
    assert isinstance(open_archive(config), Bucket)
    keys.write_text("one\n")
    with pytest.raises(ConfigError, match="access key id and the secret"):
        open_archive(config)


@pytest.mark.parametrize("url", ["s3://", "s3://a", "s3://KEY:SECRET@bucket", "s3://Bucket", "http://host/x", "ftp://x"])
def test_what_is_no_archive_is_refused_without_being_shown(url: str) -> None:
    with pytest.raises(ValidationError) as refused:
        ArchiveConfig.model_validate({"url": url})
    assert "SECRET" not in refused.value.errors()[0]["msg"]


def test_a_relative_folder_starts_at_the_configuration_file(tmp_path: Path) -> None:
    config = ArchiveConfig.model_validate({"url": "bodies"}, context={"folder": tmp_path})
    assert config.url == tmp_path / "bodies"


def test_a_pipe_or_a_folder_by_the_name_of_a_body_is_no_body(tmp_path: Path) -> None:
    archive, digests = Folder(tmp_path), [bytes([n]) * 32 for n in range(2)]
    for digest in digests:
        (tmp_path / digest.hex()[:2]).mkdir()
    os.mkfifo(tmp_path / digests[0].hex()[:2] / digests[0].hex())
    (tmp_path / digests[1].hex()[:2] / digests[1].hex()).mkdir()
    assert [archive.get(digest, 100) for digest in digests] == [None, None]
