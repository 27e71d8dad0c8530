"""An sshd with everything of its own: host key, authorised key, process id file; nothing of /etc/ssh is read."""

import os
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path

from namespaces import checked, environment

READY = "Server listening"  # what it says when it is
PRIVILEGES = "/run/sshd"  # it wants this folder; a container has no service that makes it
CONFIG = """
ListenAddress {address}
HostKey {folder}/host_key
PidFile {folder}/sshd.pid
AuthorizedKeysFile {client}
StrictModes no
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
PermitRootLogin prohibit-password
UseDNS no
MaxStartups 100
Subsystem sftp internal-sftp
SetEnv {variables}
"""


def command(address: str, folder: Path, client: Path, variables: Mapping[str, str]) -> list[str]:
    """Write a configuration into a folder and return what starts the sshd.

    Args:
        client: public key that may log in.
        variables: that every session gets.
    """
    given = " ".join(shlex.quote(f"{key}={value}") for key, value in variables.items())
    config = folder / "sshd_config"
    config.write_text(CONFIG.format(address=address, folder=folder, client=client, variables=given))
    os.makedirs(PRIVILEGES, mode=0o755, exist_ok=True)
    program = shutil.which("sshd", path=environment()["PATH"]) or "sshd"  # it insists on an absolute path
    return [program, "-D", "-e", "-f", str(config)]


def make_key(path: Path) -> str:
    """Make a pair of keys without passphrase and return the public one's line."""
    checked(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", str(path)])
    return path.with_suffix(".pub").read_text()
