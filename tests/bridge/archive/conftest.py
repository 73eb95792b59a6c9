"""A store that speaks S3, for the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bridge.archive.s3 import S3


@pytest.fixture(scope="module")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[S3]:
    server = S3(tmp_path_factory.mktemp("s3"))
    yield server
    server.kill()
