"""`systemctl`, as far as docs/operations.md needs it, on a machine that was not started by systemd.

enable --now UNIT: verified by systemd-analyze, then started as its User with its credentials and an environment of its
own, until it says READY=1; its output goes to /etc/journal. reload UNIT: its ExecReload.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

UNITS, RUN = Path("/etc/systemd/system"), Path("/opt/run")


def settings(unit: str) -> dict[str, str]:
    lines = (UNITS / f"{unit}.service").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))


def start(unit: str) -> None:
    subprocess.run(["systemd-analyze", "verify", "--man=no", str(UNITS / f"{unit}.service")], check=True)
    known, folder = settings(unit), RUN / unit
    user = known["User"]
    folder.mkdir(parents=True)
    name, _, file = known["LoadCredential"].partition(":")
    shutil.copy(file, folder / name)
    for path, mode in ((folder / name, 0o400), (folder, 0o700)):
        path.chmod(mode)
        shutil.chown(path, user, known["Group"])
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + unit)
        environment = {"PATH": "/usr/bin:/bin", "CREDENTIALS_DIRECTORY": str(folder), "NOTIFY_SOCKET": f"@{unit}"}
        command = shlex.split(known["ExecStart"])
        with Path("/etc/journal").open("ab") as journal:
            process = subprocess.Popen(command, cwd="/", env=environment, user=user, group=known["Group"],
                                       extra_groups=[], stdin=subprocess.DEVNULL, stdout=journal, stderr=journal)
        (RUN / f"{unit}.pid").write_text(str(process.pid))
        manager.settimeout(60)
        while manager.recv(100) != b"READY=1":
            continue
    assert Path(f"/proc/{process.pid}").owner() == user


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["daemon-reload"]:
            pass
        case ["enable", "--now", unit]:
            start(unit)
        case ["reload", unit]:
            assert settings(unit)["ExecReload"] == "/bin/kill -HUP $MAINPID"
            os.kill(int((RUN / f"{unit}.pid").read_text()), signal.SIGHUP)
        case other:
            raise SystemExit(f"systemctl {other} is not known here")
