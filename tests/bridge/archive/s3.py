"""A store that speaks S3, started by the tests: s3rver, which keeps its objects in a folder, so that it can be killed
and started again. `.ci/run` installs it; S3RVER is its program."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

from rosbridge_eth.config.models import ArchiveConfig

BUCKET, SECRET = "robots", "S3RVER"  # its only account, id and secret alike


class S3:
    """One server; `start` after `kill` finds what it held."""

    def __init__(self, folder: Path) -> None:
        self.program = os.environ.get("S3RVER") or shutil.which("s3rver")
        if self.program is None:
            from conftest import unavailable  # benchmarks/video.py, which comes by here, has another one

            unavailable("no S3 server: npm install s3rver, and S3RVER names node_modules/.bin/s3rver")
        self.folder, self.process = folder, None
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.objects, self.keys = folder / "objects", folder / "keys"
        self.objects.mkdir()
        self.keys.write_text(f"{SECRET}\n{SECRET}\n")
        self.keys.chmod(0o600)
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [str(self.program), "-d", str(self.objects), "-a", "127.0.0.1", "-p", str(self.port), "-s",
             "--configure-bucket", BUCKET],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError("s3rver does not come up")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def config(self, prefix: str = "fleet/a", **more: object) -> ArchiveConfig:
        given = {"url": f"s3://{BUCKET}/{prefix}", "endpoint": f"http://127.0.0.1:{self.port}", "keys": str(self.keys)}
        return ArchiveConfig.model_validate(given | more)

    def toml(self, prefix: str = "fleet/a") -> str:
        return (
            f'\n[archive]\nurl = "s3://{BUCKET}/{prefix}"\nendpoint = "http://127.0.0.1:{self.port}"\n'
            f'keys = "{self.keys}"\n'
        )

    def files(self) -> list[Path]:
        """The objects, as the server keeps them."""
        return sorted((self.objects / BUCKET).rglob("*._S3rver_object"))
