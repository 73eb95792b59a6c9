"""Where passphrases come from: a file, the service manager's credentials folder, or a prompt. Never argv.

The file is named by an option or by $ROSBRIDGE_ETH_NAME_PASSPHRASE_FILE (NAME in capitals). systemd hands secrets to a
service as files in $CREDENTIALS_DIRECTORY (systemd.exec(5), LoadCredential=); there the passphrase is called
rosbridge-eth-NAME.
"""

from __future__ import annotations

import getpass
import os
import shlex
import stat
import sys
from collections.abc import Mapping
from pathlib import Path

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.terminal import talk


def passphrase_file(name: str, environment: Mapping[str, str] = os.environ) -> Path | None:
    """The file that holds the passphrase called `name`, where the environment names one."""
    if named := environment.get(f"ROSBRIDGE_ETH_{name.upper()}_PASSPHRASE_FILE"):
        return Path(named)
    file = Path(environment.get("CREDENTIALS_DIRECTORY", "/"), f"rosbridge-eth-{name}")
    return file if file.exists() else None


def read_passphrase(
    name: str, prompt: str, *, file: Path | None = None, confirm: bool = False,
    environment: Mapping[str, str] = os.environ,
) -> bytes:
    """The passphrase called `name` ("operator", "robot", "reader", "ca"), without its line end.

    Looked for in `file`, then where `passphrase_file` says, then asked for (twice with `confirm`). IdentityError
    where there is none.
    """
    if file := file or passphrase_file(name, environment):
        return _from_file(file)
    option = "--password-file" if name == "robot" or (name == "reader" and confirm) else "--passphrase-file"
    if not sys.stdin.isatty():
        raise IdentityError(f"the {name} passphrase is needed and there is no terminal to ask at: give {option}")
    try:
        passphrase = getpass.getpass(f"{prompt}: ")
        again = getpass.getpass(f"{prompt} (again): ") if confirm else passphrase
    except EOFError:  # Ctrl-D: nobody who would answer
        sys.stderr.write("\n")  # the prompt's line has no end yet
        raise IdentityError(f"the {name} passphrase is needed and none was given: give {option}") from None
    if again != passphrase:
        raise IdentityError("the two passphrases differ; nothing was written")
    if not passphrase:
        raise IdentityError("an empty passphrase protects nothing; choose another")
    return passphrase.encode()


def warn_if_others_read(*files: Path) -> None:
    """Say which of these files other users of this machine may read. OSError."""
    for file in files:
        if file.stat().st_mode & (stat.S_IRGRP | stat.S_IROTH):
            talk(f"{file} may be read by other users of this machine: chmod 600 {shlex.quote(str(file))}")


def _from_file(file: Path) -> bytes:
    try:
        warn_if_others_read(file)
        lines = file.read_bytes().splitlines()
    except OSError as error:
        raise IdentityError(f"cannot read the passphrase file {file}: {error.strerror}") from error
    if not lines or not lines[0]:
        raise IdentityError(f"the passphrase file {file} is empty; put the passphrase on its first line")
    return lines[0]
