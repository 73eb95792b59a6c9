"""Where the bodies of archived chunks rest: a folder, or a bucket of a store that speaks S3.

An object is a body and nothing else, and is named by its digest, ab/ab… (64 hex digits): putting it again changes
nothing, and a folder can be copied into a bucket. What is put is durable on return. An archive keeps what it is given
and proves nothing: whoever reads a body holds it against its digest.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from rosbridge_eth.errors import ConfigError, StoreError
from rosbridge_eth.files import read_file, write_atomically
from rosbridge_eth.logs import one_line
from smcrypto import sm3

if TYPE_CHECKING:
    from rosbridge_eth.config.models import ArchiveConfig

S3: Final = "s3://"
_CONNECT_TIME, _TIME = timedelta(seconds=5), timedelta(seconds=60)
PROBE: Final = b"rosbridge-eth: whether this archive can be written and read\n"


class ArchiveAway(StoreError):
    """The archive does not answer, or refuses."""


class Archive(Protocol):
    """Every method may raise ArchiveAway."""

    def put(self, digest: bytes, body: bytes) -> None:
        """Keep a body."""

    def get(self, digest: bytes, length: int) -> bytes | None:
        """What is there by this name, cut off one byte behind `length`; None where nothing is."""

    def check(self) -> None:
        """Put an object and read it; it is always the same, so it stays one."""
        digest = sm3.digest(PROBE)
        self.put(digest, PROBE)
        if self.get(digest, len(PROBE)) != PROBE:
            raise ArchiveAway(f"{self} does not give back what it was given")


class Folder(Archive):
    """A folder, which is there: one on a disk that is not mounted is not made in its place."""

    def __init__(self, path: Path) -> None:
        self._path, self._synced = path, set[str]()

    def __str__(self) -> str:
        return f"the archive {self._path}"

    @contextmanager
    def _using(self, digest: bytes) -> Iterator[Path]:
        try:
            if not self._path.is_dir():
                raise ArchiveAway(f"{self} is not there; mount it, make the folder, or correct [archive] url")
            yield self._path / _name(digest)
        except OSError as error:
            raise ArchiveAway(f"{self} cannot be used: {error.strerror or error}") from error

    def put(self, digest: bytes, body: bytes) -> None:
        with self._using(digest) as path:
            # Whoever made it may not have come to that; and who copied it elsewhere may have removed it since.
            if path.parent.name not in self._synced or not path.parent.is_dir():
                path.parent.mkdir(exist_ok=True)
                folder = os.open(self._path, os.O_RDONLY)
                try:
                    os.fsync(folder)
                finally:
                    os.close(folder)
                self._synced.add(path.parent.name)
            write_atomically(path, body)

    def get(self, digest: bytes, length: int) -> bytes | None:
        with self._using(digest) as path:
            if not path.is_file():  # nothing, or a pipe, which would be waited for
                return None
            with path.open("rb") as file:
                return file.read(length + 1)


class Bucket(Archive):
    """A bucket, through obstore. Not to be carried over a fork. ConfigError without obstore, or for its keys."""

    def __init__(self, config: ArchiveConfig) -> None:
        settings = _settings(config)
        import obstore
        from obstore.store import S3Store

        self._obstore: Any = obstore
        self._url = str(config.url)
        bucket, _, prefix = self._url.removeprefix(S3).partition("/")
        self._store: Any = S3Store(
            bucket, prefix=prefix or None, config={key: value for key, value in settings.items() if value},  # type: ignore[arg-type]
            client_options={
                "connect_timeout": _CONNECT_TIME, "timeout": _TIME,
                "allow_http": (config.endpoint or os.environ.get("AWS_ENDPOINT_URL", "")).startswith("http://"),
            },
            retry_config={"max_retries": 2, "retry_timeout": _TIME},
        )  # fmt: skip

    def __str__(self) -> str:
        return f"the archive {self._url}"

    @contextmanager
    def _using(self) -> Iterator[None]:
        try:
            yield
        except (OSError, self._obstore.exceptions.BaseError) as error:  # its text goes on for pages
            text = one_line(str(error).partition("\n")[0])[:250]
            mend = "see that it is up, and that endpoint, region and keys in [archive] are right"
            raise ArchiveAway(f"{self} cannot be used: {text}; {mend}") from None

    def put(self, digest: bytes, body: bytes) -> None:
        with self._using():
            self._obstore.put(self._store, _name(digest), body, use_multipart=False)

    def get(self, digest: bytes, length: int) -> bytes | None:
        with self._using():
            try:
                body = bytearray()  # as much as is asked for, whatever the store sends
                given = self._obstore.get(self._store, _name(digest))  # no range: of no bytes there is none
                for part in given.stream(min_chunk_size=65536):
                    body += memoryview(part)[: length + 1 - len(body)]
                    if len(body) > length:
                        break
                return bytes(body)
            except FileNotFoundError as error:
                if "NoSuchBucket" in str(error):  # nothing is known of what it holds
                    raise
                return None


def open_archive(config: ArchiveConfig) -> Archive:
    """The archive that the configuration names; nothing is asked of it yet."""
    return Folder(config.url) if isinstance(config.url, Path) else Bucket(config)


def check_settings(config: ArchiveConfig) -> None:
    """ConfigError where `open_archive` raises one; loads nothing that must not be carried over a fork."""
    if not isinstance(config.url, Path):
        _settings(config)


def _settings(config: ArchiveConfig) -> dict[str, str | None]:
    """What a bucket's client is told. A bucket that locks its objects wants their checksum."""
    if find_spec("obstore") is None:
        raise ConfigError("an archive in S3 takes obstore: pip install 'obstore<1'")
    settings = {"endpoint": config.endpoint, "region": config.region, "checksum_algorithm": "SHA256"}
    if config.keys is not None:
        words = read_file(config.keys, private=True).decode("ascii", "replace").split()
        if len(words) != 2:
            raise ConfigError(f"{config.keys} holds {len(words)} words; write the access key id and the secret")
        settings["access_key_id"], settings["secret_access_key"] = words
    return settings


def _name(digest: bytes) -> str:
    return f"{digest.hex()[:2]}/{digest.hex()}"
