"""An sshd with its own host key, authorised key and process id file; it reads nothing from /etc/ssh."""

import os
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path

from namespaces import checked, environment

READY = "Server listening"  # printed by sshd once it is ready
PRIVILEGES = "/run/sshd"  # folder that sshd requires; a container has no service that creates it
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
    """Write a configuration into a folder and return the command that starts the sshd.

    Args:
        client: public key that may log in.
        variables: environment variables of every session.
    """
    given = " ".join(shlex.quote(f"{key}={value}") for key, value in variables.items())
    config = folder / "sshd_config"
    config.write_text(CONFIG.format(address=address, folder=folder, client=client, variables=given))
    os.makedirs(PRIVILEGES, mode=0o755, exist_ok=True)
    program = shutil.which("sshd", path=environment()["PATH"]) or "sshd"  # sshd must be called by an absolute path
    return [program, "-D", "-e", "-f", str(config)]


def make_key(path: Path) -> str:
    """Create a key pair without a passphrase and return the line of the public key."""
    checked(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", str(path)])
    return path.with_suffix(".pub").read_text()
